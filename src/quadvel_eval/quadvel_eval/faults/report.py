"""Writes the result of the fault campaign as JSON, table and picture.

`campaign` runs and judges the cases.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from quadvel_nodes.number_text import counted
from quadvel_recordings.output import atomic_write

from ..report import write_json
from .campaign import (
    MAX_OVERTRAVEL_IN_FALL_RAD,
    MAX_OVERTRAVEL_RAD,
    MAX_SPEED_RATIO,
    OBSERVATION_TIME_S,
    SCHEMA,
    FaultRun,
    summarise_cases,
)

Entries = Sequence[dict[str, Any]]
"""Summaries of the cases by `campaign.summarise_cases`.

`named_after` and `safe_after` are the median and the largest time (s) from the fault to the first
expected finding, and to the expected end. `torque` and `speed` are the largest ratios to the
drive's limit, and `beyond` is the largest overtravel, rad. `named` lists the expected findings that
occurred, and `wrong` the violations.
"""


def write_campaign(folder: Path, runs: Sequence[FaultRun]) -> dict[str, Any]:
    """Write faults.json (runs and cases), faults.md (table) and faults.png (reaction times).

    Args:
        folder: Folder of the files.
        runs: All runs.

    Returns:
        Content of faults.json.
    """
    entries = summarise_cases(runs)
    result = {
        "schema": SCHEMA,
        "limits": {
            "torque": 1.0,
            "speed": MAX_SPEED_RATIO,
            "beyond": MAX_OVERTRAVEL_RAD,
            "beyond_in_a_fall": MAX_OVERTRAVEL_IN_FALL_RAD,
        },
        "cases": entries,
        "runs": [attrs.asdict(run) for run in runs],
    }
    write_json(folder / "faults.json", result)
    with atomic_write(folder / "faults.md") as draft:
        draft.write_text(markdown(entries))
    with atomic_write(folder / "faults.png") as draft:
        reaction_time_figure(entries).savefig(draft, dpi=150)
    return result


def campaign_summary(entries: Entries) -> str:
    """Summarise the campaign in one sentence.

    Args:
        entries: Summaries of the cases.

    Returns:
        The sentence, without a full stop.
    """
    runs, good = (sum(entry[name] for entry in entries) for name in ("runs", "as_expected"))
    worst = {name: max(entry[name] for entry in entries) for name in ("torque", "speed", "beyond")}
    kinds = {entry["case"].rsplit(" ", 1)[0] for entry in entries}
    return (
        f"{counted(len(kinds), 'kind')} of fault in {counted(len(entries), 'case')}, {counted(runs, 'run')}, {good} as "
        f"expected; largest torque "
        f"{worst['torque']:.2f} and speed under drive {worst['speed']:.2f} of the drive's limit, "
        f"{worst['beyond']:.2f} rad into a mechanical stop"
    )


def campaign_table(entries: Entries) -> Table:
    """Create a table of the cases with an unexpected reaction.

    Args:
        entries: Summaries of the cases.

    Returns:
        The table.
    """
    table = Table("case", "as expected", "violations", title="Unexpected reactions")
    for entry in entries:
        if entry["as_expected"] < entry["runs"]:
            table.add_row(
                entry["case"], f"{entry['as_expected']} of {entry['runs']}", "; ".join(entry["wrong"])
            )
    return table


def markdown(entries: Entries) -> str:
    """Create a Markdown table of all cases with their reaction times.

    Args:
        entries: Summaries of the cases.

    Returns:
        The text of faults.md.
    """
    head = [
        "| case | as expected | finding | until finding, s | expected end | until end, s | torque | speed | falls |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    rows = [
        f"| {entry['case']} | {entry['as_expected']} of {entry['runs']} | {', '.join(entry['named']) or '-'} "
        f"| {_times(entry['named_after'])} | {entry['ends']} | {_times(entry['safe_after'])} "
        f"| {entry['torque']:.2f} | {entry['speed']:.2f} | {entry['falls']} |"
        for entry in entries
    ]
    note = (
        "Times: median and largest over the seeds, since the fault. Torque and speed (of joints that their drive accelerates): "
        "largest, divided by the limit of the drive."
    )
    return "\n".join([*head, *rows, "", note, "", f"{campaign_summary(entries)}.", ""])


def _times(times: list[float] | None) -> str:
    """Median and largest time as text."""
    return "-" if times is None else f"{times[0]:.3f}, {times[1]:.3f}"


def reaction_time_figure(entries: Entries) -> Figure:
    """Plot median and largest reaction time of each case.

    Args:
        entries: Summaries of the cases.

    Returns:
        The figure.
    """
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
    axes.set_xlim(1e-3, OBSERVATION_TIME_S)
    axes.set_xscale("log")
    axes.set_xlabel("time since the fault, s (dot: median, line: to the largest)")
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="lower right")
    return picture
