"""Runs `quadvel demo follow --tour`: a tour with progress bar, table and files."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from .tour import Tour, TourSample, TourSetup
from .tour_report import tour_table, write_tour

BAR_UPDATE_INTERVAL = 20  # moments, a second: how often the bar moves
MAX_PROGRESS_LINES = 20  # in all, where there is no terminal that shows a bar


def run_tour(setup: TourSetup, out: Path, console: Console) -> bool:
    """Simulate a tour, print its figures and write its files.

    Ctrl-C ends the walk early; its figures are written nevertheless.

    Args:
        setup: World, robot and length of the tour.
        out: Folder of the files.
        console: Console of bar and table.

    Returns:
        Whether the robot neither fell nor touched anything.

    Raises:
        KeyboardInterrupt: Ctrl-C ended the walk.
    """
    tour = Tour(setup)
    moments: list[TourSample] = []
    columns = (
        TextColumn("{task.description:32}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} m"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("sets out", total=setup.path_length)
        told, is_stopped = 0.0, False
        try:
            for moment in tour.samples():
                moments.append(moment)
                if len(moments) % BAR_UPDATE_INTERVAL == 0:
                    bar.update(task, completed=tour.walked, description=moment.words)
                if not console.is_terminal and tour.walked >= told:
                    console.print(f"{tour.walked:.0f} of {setup.path_length:.0f} m: {moment.words}")
                    told += setup.path_length / MAX_PROGRESS_LINES
        except KeyboardInterrupt:
            is_stopped = True
    if moments:
        console.print(tour_table(write_tour(out, tour.world, tour.outcome, moments)))
        console.print(f"written to {out}: tour.json, tour.png; no video is drawn of a tour")
    if is_stopped:
        raise KeyboardInterrupt
    return bool(moments) and not (tour.fell or tour.simulator.touched)
