"""Runs `quadvel demo follow --tour`: a tour with progress bar, table and files."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from .tour import Tour, TourSample, TourSetup
from .tour_report import tour_table, write_tour

BAR_UPDATE_INTERVAL = 20  # samples, one second
MAX_PROGRESS_LINES = 20  # in total, without a terminal


def run_tour(setup: TourSetup, out: Path, console: Console) -> bool:
    """Simulate a tour, print its figures and write its files.

    Ctrl-C ends the walk early; its figures are written nevertheless.

    Args:
        setup: World, robot and length of the tour.
        out: Folder of the files.
        console: Console of bar and table.

    Returns:
        Whether the robot neither fell nor touched anything, and was not stuck.

    Raises:
        KeyboardInterrupt: Ctrl-C ended the walk.
    """
    tour = Tour(setup)
    samples: list[TourSample] = []
    columns = (
        TextColumn("{task.description:32}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} m"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("start", total=setup.path_length)
        next_report, is_stopped = 0.0, False
        try:
            for sample in tour.samples():
                samples.append(sample)
                if len(samples) % BAR_UPDATE_INTERVAL == 0:
                    bar.update(task, completed=tour.walked, description=sample.words)
                if not console.is_terminal and tour.walked >= next_report:
                    console.print(f"{tour.walked:.0f} of {setup.path_length:.0f} m: {sample.words}")
                    next_report += max(setup.path_length / MAX_PROGRESS_LINES, 1.0)  # m
        except KeyboardInterrupt:
            is_stopped = True
    if samples:
        console.print(tour_table(write_tour(out, tour.world, tour.outcome, samples)))
        console.print(f"written to {out}: tour.json, tour.png; a tour has no video")
    if is_stopped:
        raise KeyboardInterrupt
    return bool(samples) and not (tour.fell or tour.stuck or tour.simulator.touch_counts)
