"""Tables of the score: rows of `verdicts.score_report` as Markdown and CSV."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]

GROUPS = {
    "table 4": "Table 4 of the paper",
    "none": "The actuator model without effects",
    "alone": "One effect of the registry",
    "together": "Two or three effects together",
    "outside": "One effect outside the registry",
}
TARGETS = {"table 4": "each", "none": "95 %", "alone": "95 %", "together": "80 %", "outside": "90 %"}


def markdown(rows: list[Row], seed: int) -> str:
    """Build the page of the benchmark.

    Args:
        rows: Rows of the score.
        seed: Seed of the benchmark.

    Returns:
        Markdown text.
    """
    done = [row for row in rows if "error" not in row]
    parts = [
        "# Score of the identification on logs with an undeclared effect\n",
        f"{len(rows)} logs, seed {seed}; made by `python -m benchmarks.identification.score`, whose generator shares no code with"
        " the registry. Half of the logs of a kind lift feet (Eq. 9 of the paper, with varied rates and heights), half use"
        " mixed motions; the error of each effect is at least 0.3 of the torque noise. Errors are mean squares over held-out"
        " samples, as multiples of the true floor (torque noise, and encoder noise through the gains): median and 90 %"
        " quantile.\n",
        _overview(rows, done),
    ]
    for group, title in GROUPS.items():
        kinds = list(dict.fromkeys(row["kind"] for row in rows if row["group"] == group))
        if kinds:
            parts.append(
                f"## {title}\n\n"
                + _kinds_table(group, [[r for r in rows if r["kind"] == kind] for kind in kinds])
            )
    return "\n".join(parts)


def _overview(rows: list[Row], done: list[Row]) -> str:
    """Table of the groups of logs, coverage of the intervals, time and commits."""
    lines = ["| | logs | named correctly | target | within the target error |", "|---|---|---|---|---|"]
    for group, title in GROUPS.items():
        mine = [row for row in rows if row["group"] == group]
        if mine:
            right = np.mean([row.get("verdict") == "right" for row in mine])
            within = np.mean([bool(row.get("within")) for row in mine])
            lines.append(f"| {title} | {len(mine)} | {right:.0%} | {TARGETS[group]} | {within:.0%} |")
    intervals = [interval["covered"] for row in done for interval in row["intervals"]]
    if intervals:
        lines.append(
            f"\n95 % intervals of {len(intervals)} parameters cover the truth in {np.mean(intervals):.0%}."
        )
    if done:
        seconds = [row["seconds"] for row in done]
        lines.append(
            f"\nComputing time of a log: median {np.median(seconds):.1f} s, maximum {max(seconds):.1f} s."
        )
    engines = Counter(row.get("engine", "unknown") for row in rows)
    lines.append(
        "\nCommits of the identification: "
        + ", ".join(f"{name} ({count} logs)" for name, count in engines.most_common())
        + "."
    )
    failed = len(rows) - len(done)
    if failed:
        lines.append(f"\n{failed} logs ended in an error.")
    return "\n".join(lines) + "\n"


def _kinds_table(group: str, kinds: list[list[Row]]) -> str:
    """Table of the kinds of logs of one group."""
    lines = [
        "| effect | logs | right | other verdicts | further effects | right joints (signals) "
        "| before | after | within | intervals | s |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for rows in kinds:
        done = [row for row in rows if "error" not in row]
        lines.append(
            " | ".join(
                (
                    f"| {rows[0]['kind']}",
                    str(len(rows)),
                    f"{sum(row.get('verdict') == 'right' for row in rows)}",
                    _other_verdicts(rows),
                    _counts(name for row in done for name in row["extra"])
                    if group in ("alone", "together")
                    else "",
                    str(sum(row["all_signals" if group == "outside" else "right_joints"] for row in done)),
                    _spread([row["before"] / row["floor"] for row in done]),
                    _spread([row["after"] / row["floor"] for row in done]),
                    f"{sum(row['within'] for row in done)}",
                    _coverage(done),
                    f"{np.median([row['seconds'] for row in done]):.0f} |" if done else " |",
                )
            )
        )
    return "\n".join(lines) + "\n"


def _other_verdicts(rows: list[Row]) -> str:
    """Verdicts other than right, most frequent first."""
    others = []
    for row in rows:
        verdict = row.get("verdict", f"error: {row.get('error', '')[:40]}")
        if verdict != "right":
            first = row.get("named", [])[:1] if row["group"] == "alone" else row.get("named", [])
            named = "+".join(first)
            others.append(f"{verdict} ({named})" if named else verdict)
    return _counts(others)


def _counts(items: Iterable[str]) -> str:
    return ", ".join(f"{count} {item}" for item, count in Counter(items).most_common())


def _spread(values: list[float]) -> str:
    return f"{np.median(values):.2f}, {np.quantile(values, 0.9):.2f}" if values else ""


def _coverage(rows: list[Row]) -> str:
    covered = [interval["covered"] for row in rows for interval in row["intervals"]]
    return f"{sum(covered)} of {len(covered)}" if covered else ""


COLUMNS = (
    *("name", "kind", "group", "motion", "joints", "effects", "verdict", "named", "extra", "right_joints"),
    *(
        "before",
        "after",
        "floor",
        "floor_estimate",
        "removed",
        "within",
        "unexplained",
        "depends_on",
        "seconds",
        "error",
    ),
)


def write_csv(rows: list[Row], path: Path) -> None:
    """Write the rows of the score as CSV.

    Args:
        rows: Rows of the score.
        path: File to write.
    """
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        for row in rows:
            writer.writerow(
                {
                    key: " ".join(row[key]) if isinstance(row[key], list) else row[key]
                    for key in COLUMNS
                    if key in row
                }
            )
