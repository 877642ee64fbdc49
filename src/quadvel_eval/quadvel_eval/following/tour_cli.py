"""`quadvel demo follow --tour`: a tour with a bar, its table and files."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from .tour import Moment, Tour, TourSetup
from .tour_report import tour_table, write_tour

EVERY = 20  # moments, a second: how often the bar moves
LINES = 20  # in all, where there is no terminal that shows a bar


def run_tour(setup: TourSetup, out: Path, console: Console) -> bool:
    """Follow through a world as `setup` has it; whether the robot neither fell nor touched anything.

    Ctrl-C ends the walk early: what there is of it is judged and written. Raises KeyboardInterrupt then.
    """
    tour = Tour(setup)
    moments: list[Moment] = []
    columns = (
        TextColumn("{task.description:32}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} m"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("sets out", total=setup.metres)
        told, is_stopped = 0.0, False
        try:
            for moment in tour.moments():
                moments.append(moment)
                if len(moments) % EVERY == 0:
                    bar.update(task, completed=tour.walked, description=moment.words)
                if not console.is_terminal and tour.walked >= told:
                    console.print(f"{tour.walked:.0f} of {setup.metres:.0f} m: {moment.words}")
                    told += setup.metres / LINES
        except KeyboardInterrupt:
            is_stopped = True
    if moments:
        console.print(tour_table(write_tour(out, tour.world, tour.outcome, moments)))
        console.print(f"written to {out}: tour.json, tour.png; no video is drawn of a tour")
    if is_stopped:
        raise KeyboardInterrupt
    return bool(moments) and not (tour.fell or tour.simulator.touch_counts)
