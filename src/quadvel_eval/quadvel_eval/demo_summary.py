"""Computes `summary.json` of a demo: tracking by segments, falls, timing and estimator errors.

`demo_figures` draws the same recording. Velocities are vx, vy (m/s) and wz (rad/s), times in s.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadvel_description.arrays import Array, Bools

from .recording import Recording
from .segments import SETTLING_TIME_S, Segment, measure_segment, rounded, tracking_errors

MAX_COMMAND_GAP_S = 2.0  # a longer silence ends a segment; a shorter one is a stall and counts
MIN_SEGMENT_S = SETTLING_TIME_S + 0.5  # shorter segments are left out
MAX_TILT_RAD = 1.0  # rad
MIN_TRUNK_HEIGHT_M = 0.2  # standing: 0.43, lying: 0.14
UPRIGHT_MODES = ("stance", "walk", "fault")  # in these modes a lying robot has fallen


def constant_commands(planned_time: Array, planned: Array) -> list[tuple[float, float, Array]]:
    """Split a plan into intervals of constant command, without those shorter than MIN_SEGMENT_S.

    Args:
        planned_time: Times of the commands (n,), s.
        planned: Commands (n, 3): vx, vy (m/s), wz (rad/s).

    Returns:
        Start (s), end (s) and command of each interval.
    """
    if not len(planned_time):
        return []
    changed = np.any(np.diff(planned, axis=0) != 0.0, axis=1) | (np.diff(planned_time) > MAX_COMMAND_GAP_S)
    runs = np.split(np.arange(len(planned_time)), np.flatnonzero(changed) + 1)
    found = [(float(planned_time[r[0]]), float(planned_time[r[-1]]), planned[r[0]]) for r in runs]
    return [(start, end, velocity) for start, end, velocity in found if end - start >= MIN_SEGMENT_S]


def count_falls(height: Array, quaternion: Array, upright: Bools) -> int:
    """Count how often the robot changed from standing to lying.

    Args:
        height: Height of the trunk (n,), m.
        quaternion: Orientation of the trunk (n, 4), w, x, y, z.
        upright: Whether the robot should stand (n,); otherwise only its tilt indicates a fall.

    Returns:
        Number of falls.
    """
    # Third diagonal element of the rotation matrix: cos(tilt) = 1 - 2 (x^2 + y^2).
    tilt_cosine = 1.0 - 2.0 * (quaternion[:, 1] ** 2 + quaternion[:, 2] ** 2)
    down = (tilt_cosine < np.cos(MAX_TILT_RAD)) | ((height < MIN_TRUNK_HEIGHT_M) & upright)
    return int(np.count_nonzero(down[1:] & ~down[:-1]) + (down[0] if len(down) else 0))


def recorded_segments(recording: Recording) -> list[Segment]:
    """Measure each interval of constant command, after its settling time.

    Args:
        recording: The recording.

    Returns:
        The segments.
    """
    truth = recording.velocity
    planar = truth.value[:, [0, 1, 5]]
    return [
        measure_segment(truth.time, planar, velocity, start + SETTLING_TIME_S, end)
        for start, end, velocity in constant_commands(recording.planned.time, recording.planned.value)
    ]


def summarise_demo(recording: Recording) -> dict[str, Any]:
    """Compute the content of `summary.json`.

    Args:
        recording: The recording.

    Returns:
        The content.

    Raises:
        ValueError: No command lasted long enough.
    """
    walked = recorded_segments(recording)
    if not walked:
        raise ValueError(f"found no command of {MIN_SEGMENT_S:g} s or more, expected one to evaluate")
    return {
        "segments": [segment.to_json() for segment in walked],
        "falls": _falls(recording),
        **tracking_errors(walked),
        "loop": _loop_figures(recording),
        "estimator": {"rmse": rounded(_estimator_rmse(recording))},
        "realtime_factor": rounded(_mean(recording.realtime_factor.value)),
    }


def _mean(values: Array) -> float:
    """Mean; nan without values."""
    return float(values.mean()) if len(values) else float("nan")


def _falls(recording: Recording) -> int:
    """Count the falls of a recording. Before the controller's first report the robot may lie."""
    loop = recording.loop
    upright = np.array([False, *(mode in UPRIGHT_MODES for mode in loop.mode)])
    reports_so_far = np.searchsorted(loop.time, recording.position.time, side="right")
    return count_falls(recording.position.value[:, 2], recording.quaternion.value, upright[reports_so_far])


def _loop_figures(recording: Recording) -> dict[str, float]:
    """The controller's last report, on the time since its start; `rate_hz` is the median while walking."""
    loop = recording.loop
    rates = [f["rate_hz"] for f, mode in zip(loop.figures, loop.mode, strict=True) if mode == "walk"]
    last = loop.figures[-1]
    figures = {**last, "rate_hz": float(np.median(rates)) if rates else last["rate_hz"]}
    return {name: int(value) if name == "overruns" else rounded(value) for name, value in figures.items()}


def _estimator_rmse(recording: Recording) -> Array:
    """RMSE of the estimate (3,), m/s, from the start of the first segment to the end of the last.

    The truth is interpolated, because behind a network the stamps of states differ from it by a
    fraction of a millisecond.
    """
    estimate, truth = recording.estimate, recording.velocity
    stretches = constant_commands(recording.planned.time, recording.planned.value)
    begin, end = max(stretches[0][0], truth.time[0]), min(stretches[-1][1], truth.time[-1])
    walking = (begin <= estimate.time) & (estimate.time < end)
    instants = estimate.time[walking]
    there = np.column_stack([np.interp(instants, truth.time, truth.value[:, axis]) for axis in range(3)])
    error = estimate.value[walking] - there
    rmse: Array = np.sqrt(np.square(error).mean(axis=0)) if len(error) else np.full(3, np.nan)
    return rmse
