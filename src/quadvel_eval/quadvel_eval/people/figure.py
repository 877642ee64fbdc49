"""Draws tracks over the scans from which they were made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from quadvel_follow.leg_detector import LegDetector

from ..report import write_figure
from .measure import ScanRecording


def draw_tracks(recording: ScanRecording, detector: LegDetector, path: Path) -> None:
    """Draw all ranges and the path of each confirmed person from above, for a sensor at rest.

    Args:
        recording: The scans.
        detector: Leg detector.
        path: File of the figure.
    """
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    axes = figure.subplots()
    angles = recording.angle_min + recording.angle_increment * np.arange(recording.ranges.shape[1])
    ahead = np.column_stack([np.cos(angles), np.sin(angles)])
    paths: dict[int, list[np.ndarray]] = {}
    for _, ranges, tracks in recording.tracks(detector):
        seen = np.isfinite(ranges) & (ranges > 0.0)
        axes.plot(*(ranges[seen, None] * ahead[seen]).T, ".", color="0.75", markersize=1.0, zorder=1)
        for track in tracks:
            if track.confirmed:
                paths.setdefault(track.id, []).append(track.position)
    for identity, path_of_person in sorted(paths.items()):
        (line,) = axes.plot(*np.array(path_of_person).T, linewidth=1.5, label=f"person {identity}", zorder=2)
        axes.plot(*path_of_person[-1], "o", color=line.get_color(), zorder=3)
    axes.plot(0.0, 0.0, "k^", markersize=9, label="laser")
    axes.set(xlabel="x, m", ylabel="y, m", title=recording.name, aspect="equal")
    axes.legend(loc="upper right")
    write_figure(path, figure)
