"""Draws the figures of a demo: velocity tracking, and timing of the control loop.

`demo_summary` computes the numbers, and `video` renders the frames above the tracking figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from quadvel_description.arrays import Array
from quadvel_nodes.number_text import DASH
from quadvel_policy.observation import CONTROL_PERIOD_S

from .demo_summary import constant_commands
from .recording import Recording, Series

AVERAGING_TIME_S = 0.4  # of plotted velocities, to remove the sway of each step
AXIS_LABELS = ("vx, m/s", "vy, m/s", "wz, rad/s")


def tracking_figure(recording: Recording, frames: Sequence[tuple[str, NDArray[np.uint8]]] = ()) -> Figure:
    """Plot commanded, true and estimated velocity over time.

    Args:
        recording: The recording.
        frames: Caption and image (h, w, 3) of each picture above the panels.

    Returns:
        The figure.
    """
    strip = 1.7 if frames else 0.0
    figure = Figure(figsize=(11, 6 + strip), layout="constrained")
    if frames:
        top, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(strip, 6))[:, 0]
        for panel, (caption, image) in zip(
            top.subplots(1, len(frames), squeeze=False)[0], frames, strict=True
        ):
            panel.imshow(image)
            panel.set_title(caption, fontsize="medium")
            panel.set_axis_off()
        _tracking_panels(below.subplots(3, 1, sharex=True), recording)
    else:
        _tracking_panels(figure.subplots(3, 1, sharex=True), recording)
    return figure


def _tracking_panels(panels: Any, recording: Recording) -> None:
    """Plot the three velocities, one panel per axis."""
    start, end = _walked_interval(recording)
    planar = Series(recording.velocity.time, recording.velocity.value[:, [0, 1, 5]])  # vx, vy, wz
    for axis, (panel, name) in enumerate(zip(panels, AXIS_LABELS, strict=True)):
        lines = [("commanded", recording.commanded, "black"), ("true", _moving_average(planar), "tab:blue")]
        if axis < 2:  # the yaw rate is measured, not estimated
            lines.append(("estimated", _moving_average(recording.estimate), "tab:orange"))
        for label, series, colour in lines:
            within = (start - 1.0 <= series.time) & (series.time <= end + 1.0)
            panel.plot(series.time[within] - start, series.value[within, axis], colour, label=label, lw=1.2)
        panel.set_ylabel(name)
        panel.grid(alpha=0.3)
    panels[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False)
    panels[-1].set_xlabel(f"time, s (true and estimated: means over {AVERAGING_TIME_S} s)")


def _walked_interval(recording: Recording) -> tuple[float, float]:
    """Start of the first and end of the last segment, s."""
    segments = constant_commands(recording.planned.time, recording.planned.value)
    return segments[0][0], segments[-1][1]


def _moving_average(series: Series) -> Series:
    """Average evenly spaced samples over AVERAGING_TIME_S."""
    return Series(
        series.time,
        uniform_filter1d(series.value, round(AVERAGING_TIME_S / CONTROL_PERIOD_S), axis=0, mode="nearest"),
    )


def loop_figure(recording: Recording) -> Figure:
    """Plot the distributions of response time and of command period.

    Args:
        recording: The recording.

    Returns:
        The figure.
    """
    answer_time = recording.answer_time  # from each state to its command, s
    sent = answer_time.time + answer_time.value[:, 0]
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    _distribution(left, 1e3 * answer_time.value[:, 0], "from state to command, ms")
    _distribution(right, 1e3 * np.diff(sent), "period of the commands, ms")
    return figure


def _distribution(panel: Any, values: Array, name: str) -> None:
    """Draw a histogram (logarithmic counts) with median and 99th percentile."""
    panel.set_xlabel(name)
    panel.set_ylabel("ticks")
    if not len(values):
        panel.text(0.5, 0.5, DASH, ha="center", transform=panel.transAxes)
        return
    median, p99 = np.quantile(values, (0.5, 0.99))
    panel.hist(values, bins=np.linspace(0.0, max(10.0, 1.5 * p99), 120), log=True, color="tab:blue")
    for value, label in ((median, "median"), (p99, "99 %")):
        panel.axvline(value, color="black", linestyle="--", linewidth=1.0)
        panel.annotate(f" {label} {value:.2f}", (value, 0.97), xycoords=("data", "axes fraction"), va="top")
