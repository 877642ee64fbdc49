"""Writes the result of a tour: tour.json, and tour.png with map, distance and speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from quadvel_follow.follow_planner import State
from quadvel_nodes.number_text import number_text
from quadvel_sim.world import World

from ..report import write_figure, write_json
from ..world_map import draw_world
from .stage import DISTANCE_BAND_M
from .tour import Outcome, TourSample, summarise_tour

PAPER_XY, PAPER_WZ = 0.077, 0.059  # m/s, rad/s: mean errors of the paper's tour of 3.1 km


def write_tour(folder: Path, world: World, outcome: Outcome, samples: Sequence[TourSample]) -> dict[str, Any]:
    """Write tour.json and tour.png.

    Args:
        folder: Folder of the files.
        world: World of the tour.
        outcome: Outcome of the tour.
        samples: Its samples.

    Returns:
        The summary, as in tour.json.
    """
    summary = summarise_tour(outcome, samples)
    write_json(folder / "tour.json", summary)
    write_figure(folder / "tour.png", tour_figure(world, outcome.distance, samples))
    return summary


def tour_figure(world: World, distance: float, samples: Sequence[TourSample]) -> Figure:
    """Draw the robot's path on the map, and below it distance and speed over time.

    Args:
        world: World of the tour.
        distance: Set distance to the person, m.
        samples: Samples of the tour.

    Returns:
        The figure.
    """
    figure = draw_world(world)
    path = np.array([one.pose[:2] for one in samples])
    time = np.array([one.time - samples[0].time for one in samples]) / 60.0
    away = np.array([np.hypot(*(one.person - one.pose)[:2]) for one in samples])
    speed = np.array([np.hypot(*one.velocity[:2]) for one in samples])
    world_map = figure.axes[0]
    world_map.plot(*path.T, color="tab:red", linewidth=0.8, zorder=7)
    wide, high = figure.get_size_inches()
    figure.set_size_inches(wide, high + 3.0)
    figure.set_layout_engine("none")
    low = 2.4 / (high + 3.0)
    world_map.set_position((0.07, low + 0.12, 0.9, 0.8 - low))
    distance_axis = figure.add_axes((0.07, 0.09, 0.86, low - 0.05))
    distance_axis.axhspan(
        distance - DISTANCE_BAND_M, distance + DISTANCE_BAND_M, color="tab:green", alpha=0.15
    )
    distance_axis.plot(time, away, color="tab:blue", linewidth=0.8)
    lost = np.array([one.state in (State.LOST, State.LOOKING) for one in samples])
    distance_axis.plot(time[lost], away[lost], ".", color="tab:red", markersize=2)
    distance_axis.set(
        xlabel="min",
        ylabel="distance, m",
        ylim=(0.0, max(4.0, float(away.max()))),
        xlim=(0.0, float(time[-1])),
    )
    speed_axis = distance_axis.twinx()
    speed_axis.plot(time, speed, color="0.6", linewidth=0.6)
    speed_axis.set(ylabel="speed, m/s", ylim=(0.0, 4.0))
    return figure


def tour_table(summary: Mapping[str, Any]) -> Table:
    """Create a table of a summary, next to the paper's numbers.

    Args:
        summary: Result of `summarise_tour`.

    Returns:
        The table.
    """
    table = Table("", "here", "paper", title=f"Following through {summary['world']}, seed {summary['seed']}")
    touched = ", ".join(f"{name} {count}x" for name, count in summary["touched"].items()) or "nothing"
    n = number_text
    rows = [
        (
            "path length",
            f"{n(summary['walked'], '.0f')} m in {n(summary['minutes'], '.1f')} min",
            "3100 m in 37 min",
        ),
        ("fell", "yes" if summary["fell"] else "no", "no"),
        ("stuck", "yes: it no longer moved on, and the tour ended" if summary["stuck"] else "no", "no"),
        ("touched", touched, ""),
        ("error of the velocity, mean", f"{n(summary['error_xy'], '.3f')} m/s", f"{PAPER_XY} m/s"),
        ("error of the yaw rate, mean", f"{n(summary['error_wz'], '.3f')} rad/s", f"{PAPER_WZ} rad/s"),
        ("distance, mean", f"{n(summary['distance_mean'], '.2f')} m", ""),
        (
            f"within {DISTANCE_BAND_M} m of the set distance",
            f"{n(summary['distance_kept'], '.0%')} of the time",
            "",
        ),
        ("smallest clearance from obstacles", _metres(summary["least_clearance"]), ""),
        ("smallest clearance from people", _metres(summary["least_gap"]), ""),
        ("person lost", f"{summary['losses']} times, {n(summary['lost_seconds'], '.0f')} s together", ""),
    ]
    if planner := summary.get("planner_ms"):
        rows.append(("planner, mean and p99", f"{planner['mean']:.1f}, {planner['p99']:.1f} ms", ""))
    for row in rows:
        table.add_row(*row)
    return table


def _metres(value: float | None) -> str:
    """Distance as text; null means that nothing was near."""
    return "nothing near" if value is None else f"{value:.2f} m"
