"""`summary.json` from the recording of a demo: tracking by segments, falls, timing, estimator errors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .recording import Recording
from .segments import SETTLE, Segment, measure, rounded, tracking_errors

Array = NDArray[np.float64]

GAP = 2.0  # s, a planner that was silent for longer had stopped; less is a stall, and what the robot did in it counts
SHORTEST = SETTLE + 0.5  # s, of a segment that can be judged
MAX_TILT = 1.0  # rad
MIN_HEIGHT = 0.2  # m, of the trunk; it stands at 0.43 and lies at 0.14
UPRIGHT_MODES = ("stance", "walk", "fault")  # in which a robot that lies has fallen


def commands(planned_time: Array, planned: Array) -> list[tuple[float, float, Array]]:
    """Start, end (s) and velocity of each stretch over which the planner sent the same.

    planned (n, 3): what it sent at the times (n,). Stretches too short to be judged are left out.
    """
    if not len(planned_time):
        return []
    changed = np.any(np.diff(planned, axis=0) != 0.0, axis=1) | (np.diff(planned_time) > GAP)
    runs = np.split(np.arange(len(planned_time)), np.flatnonzero(changed) + 1)
    found = [(float(planned_time[r[0]]), float(planned_time[r[-1]]), planned[r[0]]) for r in runs]
    return [(start, end, velocity) for start, end, velocity in found if end - start >= SHORTEST]


def count_falls(height: Array, quaternion: Array, upright: NDArray[np.bool_]) -> int:
    """How often the robot went from standing to lying: trunk height (n,) m, quaternion (n, 4).

    upright (n,): whether the robot should be on its feet; only the tilt tells a fall where it should not.
    """
    tilt_cosine = 1.0 - 2.0 * (quaternion[:, 1] ** 2 + quaternion[:, 2] ** 2)
    down = (tilt_cosine < np.cos(MAX_TILT)) | ((height < MIN_HEIGHT) & upright)
    return int(np.count_nonzero(down[1:] & ~down[:-1]) + (down[0] if len(down) else 0))


def segments(recording: Recording) -> list[Segment]:
    """Every stretch of constant command, its first two seconds left out of the means."""
    truth = recording.velocity
    planar = truth.value[:, [0, 1, 5]]
    return [
        measure(truth.time, planar, velocity, start + SETTLE, end)
        for start, end, velocity in commands(recording.planned.time, recording.planned.value)
    ]


def summarise(recording: Recording) -> dict[str, Any]:
    """The content of `summary.json`. Raises ValueError where no segment was walked."""
    walked = segments(recording)
    if not walked:
        raise ValueError("no command was held for long enough to be judged")
    return {
        "segments": [segment.to_json() for segment in walked],
        "falls": _falls(recording),
        **tracking_errors(walked),
        "loop": _loop_figures(recording),
        "estimator": {"rmse": rounded(_estimator_rmse(recording))},
        "realtime_factor": rounded(_mean(recording.realtime_factor.value)),
    }


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _falls(recording: Recording) -> int:
    loop = recording.loop
    upright = np.array([mode in UPRIGHT_MODES for mode in loop.mode])
    now = np.maximum(np.searchsorted(loop.time, recording.position.time, side="right") - 1, 0)
    return count_falls(recording.position.value[:, 2], recording.quaternion.value, upright[now])


def _loop_figures(recording: Recording) -> dict[str, float]:
    """The controller's own figures at the end, since its start; the rate as the median over the walk."""
    loop = recording.loop
    rates = [f["rate_hz"] for f, mode in zip(loop.figures, loop.mode, strict=True) if mode == "walk"]
    last = loop.figures[-1]
    figures = {**last, "rate_hz": float(np.median(rates)) if rates else last["rate_hz"]}
    return {name: int(value) if name == "overruns" else rounded(value) for name, value in figures.items()}


def _estimator_rmse(recording: Recording) -> Array:
    """Root mean square of estimate minus truth, (3,) m/s, at the instants of the estimates within the segments.

    Truth is taken between its own instants: behind a network, states have theirs to within a fraction of a millisecond.
    """
    estimate, truth = recording.estimate, recording.velocity
    stretches = commands(recording.planned.time, recording.planned.value)
    begin, end = max(stretches[0][0], truth.time[0]), min(stretches[-1][1], truth.time[-1])
    walking = (begin <= estimate.time) & (estimate.time < end)
    instants = estimate.time[walking]
    there = np.column_stack([np.interp(instants, truth.time, truth.value[:, axis]) for axis in range(3)])
    error = estimate.value[walking] - there
    rmse: Array = np.sqrt(np.square(error).mean(axis=0)) if len(error) else np.full(3, np.nan)
    return rmse
