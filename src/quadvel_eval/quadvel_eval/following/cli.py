"""Defines the command `quadvel following` for Typer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from quadvel_nodes.number_text import number_text
from quadvel_recordings.output import atomic_write, output_folder

from .measure import measure_scenes

HEADS = {
    "success": "success",
    "share": "within 0.5 m",
    "late": "settled after, s",
    "jerk": "jerk, m/s^3",
    "clearance": "clearance, m",
    "gap": "to people, m",
    "ms": "ms a step",
    "slowest": "slowest",
}


def following_command(
    out: Annotated[Path, typer.Option(metavar="<folder>", help="Folder for following.json.")] = Path(
        "out/following"
    ),
    runs: Annotated[int, typer.Option(min=1, help="Scenes of each kind.")] = 10,
) -> None:
    """Measure how well the robot follows a person, in simulated scenes in the plane."""
    output_folder(out)
    found = measure_scenes(runs)
    table = Table(f"simulated, {runs} each", *HEADS.values())
    for name, row in found.items():
        table.add_row(name, *(number_text(row[head], ".2f") for head in HEADS))
    Console(markup=False).print(table)
    with atomic_write(out / "following.json") as draft:
        draft.write_text(json.dumps(found, indent=1))
    print(f"written: {out}/following.json")
