"""The campaign's result as a file, a table and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from ..output import replacing
from ..report import write_json
from .campaign import AFTERWARDS, MAX_BEYOND, MAX_BEYOND_IN_A_FALL, MAX_SPEED, SCHEMA, Run, summary

Entries = Sequence[dict[str, Any]]


def write_campaign(folder: Path, runs: Sequence[Run]) -> dict[str, Any]:
    """faults.json (every run and every case), faults.md (a table) and faults.png (reaction times); returns what the JSON holds."""
    entries = summary(runs)
    result = {
        "schema": SCHEMA,
        "limits": {
            "torque": 1.0,
            "speed": MAX_SPEED,
            "beyond": MAX_BEYOND,
            "beyond_in_a_fall": MAX_BEYOND_IN_A_FALL,
        },
        "cases": entries,
        "runs": [attrs.asdict(run) for run in runs],
    }
    write_json(folder / "faults.json", result)
    with replacing(folder / "faults.md") as draft:
        draft.write_text(markdown(entries))
    with replacing(folder / "faults.png") as draft:
        figure(entries).savefig(draft, dpi=150)
    return result


def total(entries: Entries) -> str:
    """One sentence on all of them."""
    runs, good = (sum(entry[name] for entry in entries) for name in ("runs", "as_expected"))
    worst = {name: max(entry[name] for entry in entries) for name in ("torque", "speed", "beyond")}
    kinds = {entry["case"].rsplit(" ", 1)[0] for entry in entries}
    return (
        f"{len(kinds)} kinds of fault in {len(entries)} cases, {runs} runs, {good} as expected; largest torque "
        f"{worst['torque']:.2f} and speed under drive {worst['speed']:.2f} of the drive's limit, "
        f"{worst['beyond']:.2f} rad into a mechanical stop"
    )


def campaign_table(entries: Entries) -> Table:
    """For the terminal: the cases that are not as expected, and what they did instead."""
    table = Table("case", "as expected", "instead", title="not as expected")
    for entry in entries:
        if entry["as_expected"] < entry["runs"]:
            table.add_row(
                entry["case"], f"{entry['as_expected']} of {entry['runs']}", "; ".join(entry["wrong"])
            )
    return table


def markdown(entries: Entries) -> str:
    """Every case with its reaction times."""
    head = [
        "| component, kind, mode | as expected | named | until named, s | has to | until there, s | torque | speed | falls |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    rows = [
        f"| {entry['case']} | {entry['as_expected']} of {entry['runs']} | {', '.join(entry['named']) or '-'} "
        f"| {_times(entry['named_after'])} | {entry['ends']} | {_times(entry['safe_after'])} "
        f"| {entry['torque']:.2f} | {entry['speed']:.2f} | {entry['falls']} |"
        for entry in entries
    ]
    note = (
        "Times: median, largest over the seeds, since the fault began. Torque and speed (of joints that their drive moves on): "
        "largest, as a share of what the drive can do."
    )
    return "\n".join([*head, *rows, "", note, "", f"{total(entries)}.", ""])


def _times(times: list[float] | None) -> str:
    return "-" if times is None else f"{times[0]:.3f}, {times[1]:.3f}"


def figure(entries: Entries) -> Figure:
    """How soon each case is named and how soon the robot is safe, medians and largest."""
    timed = [
        entry for entry in entries if entry["named_after"] or (entry["safe_after"] and entry["ends"] != "any")
    ]
    picture = Figure(figsize=(9.0, 1.2 + 0.17 * len(timed)), layout="constrained")
    axes = picture.add_subplot()
    y = np.arange(len(timed))
    for name, colour, label in (("named_after", "C0", "named"), ("safe_after", "C3", "safe")):
        times = np.array([entry[name] or (np.nan, np.nan) for entry in timed]).reshape(-1, 2)
        axes.hlines(y, times[:, 0], times[:, 1], color=colour, linewidth=1.0)
        axes.plot(times[:, 0], y, "o", color=colour, markersize=3.5, label=label)
    axes.set_yticks(y, [entry["case"] for entry in timed], fontsize=6)
    axes.invert_yaxis()
    axes.set_xlim(1e-3, AFTERWARDS)
    axes.set_xscale("log")
    axes.set_xlabel("s since the fault began (dot: median, line: to the largest)")
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="lower right")
    return picture
