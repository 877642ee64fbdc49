"""Defines the command `quadvel people` for Typer."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from quadvel_follow.leg_detector import SHIPPED_MODEL, LegDetector
from quadvel_nodes.number_text import number_text
from quadvel_recordings.output import atomic_write, output_folder

from .figure import draw_tracks
from .measure import ScanRecording, measure_files, measure_scenes

Figures = Mapping[str, Mapping[str, float]]
HEADS = {
    "recall": "recall",
    "precision": "precision",
    "persons": "people",
    "persons_per_minute": "people a minute",
    "switches_per_minute": "switches a minute",
    "kept": "right person kept",
    "rms": "position, m RMS",
    "ghosts": "false tracks a scene",
    "ms": "CPU ms a scan",
}


def people_command(
    out: Annotated[
        Path, typer.Option(metavar="<folder>", help="Folder for people.json and a picture of each file.")
    ] = Path("out/people"),
    scans: Annotated[
        Path | None,
        typer.Option(
            metavar="<folder>", help="Folder with files legs_*.npz of real scans.", show_default="none"
        ),
    ] = None,
    runs: Annotated[int, typer.Option(min=0, help="Simulated scenes of each kind.")] = 100,
    model: Annotated[
        Path,
        typer.Option(metavar="<file>", help="ONNX file of the leg detector.", show_default="the shipped one"),
    ] = SHIPPED_MODEL,
) -> None:
    """Measure how well people are found and tracked in laser scans, real and simulated."""
    detector, console = LegDetector(model), Console(markup=False)
    output_folder(out)
    if scans is None and not runs:
        raise ValueError("--runs: found 0 without --scans, expected scenes or scans to measure")
    found: dict[str, Figures] = {}
    if scans is not None:
        found["scans"] = measure_files(scans, detector)
        console.print(_table("real scans", found["scans"]))
        for path in sorted(scans.glob("legs_*.npz")):
            draw_tracks(ScanRecording.load(path), detector, out / f"{path.stem}.png")
    if runs:
        found["scenes"] = measure_scenes(runs, detector)
        console.print(_table(f"simulated, {runs} scenes of each kind", found["scenes"]))
    with atomic_write(out / "people.json") as draft:
        draft.write_text(json.dumps(found, indent=1))
    console.print(f"written: {out}/people.json{', pictures' if scans is not None else ''}")


def _table(title: str, figures: Figures) -> Table:
    """Table of scores; columns without a value are left out."""
    heads = [head for head in HEADS if any(head in row for row in figures.values())]
    table = Table(title, *(HEADS[head] for head in heads))
    for name, row in figures.items():
        table.add_row(name, *(number_text(row[head], ".3g") if head in row else "" for head in heads))
    return table
