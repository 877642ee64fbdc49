"""Writes the files of a section (NAME.csv, NAME.png, NAME.json) and the page of all sections.

The JSON file is written last and records the networks and settings. A section is done if they
match.
"""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
from matplotlib.figure import Figure

from quadvel_description.robot import Robot, load_robot
from quadvel_policy.policy_file import PolicyFile
from quadvel_recordings.output import atomic_write

from ..report import read_json, write_figure, write_json
from .section import Record, Row, Section, Study, distinct

SCHEMA = 1
PAGE_FILE = "README.md"
DIGEST_LENGTH = 12  # hexadecimal digits of a SHA-256


def provenance(section: Section, study: Study) -> dict[str, Any]:
    """Return everything that determines the result of a section.

    Args:
        section: Section with its settings.
        study: Policies, estimator and seeds.

    Returns:
        JSON content; networks as digests of their files.
    """
    return {
        "policies": {name: _digest(path) for name, path in study.policies.items()},
        "estimator": study.estimator,
        "estimator_file": _digest(study.estimator_file),
        "seeds": study.seeds,
        "settings": json.loads(json.dumps(attrs.asdict(section))),
    }


def _digest(path: Path) -> str:
    """First letters of the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:DIGEST_LENGTH]


def is_done(folder: Path, section: Section, study: Study) -> bool:
    """Return whether a folder holds a section made with the same networks, seeds and settings.

    Args:
        folder: Folder of the files.
        section: The section.
        study: Policies, estimator and seeds.

    Returns:
        True if the section need not run.
    """
    path = folder / f"{section.name}.json"
    return path.exists() and bool(read_json(path)["made_with"] == provenance(section, study))


def write_section(folder: Path, section: Section, study: Study, records: Sequence[Record]) -> None:
    """Write CSV, figure and JSON of a section; figure and table are made from the CSV.

    Args:
        folder: Folder of the files.
        section: The section.
        study: Policies, estimator and seeds.
        records: Its records.
    """
    write_records(folder / f"{section.name}.csv", records)
    kept = read_records(folder / f"{section.name}.csv")
    write_figure(folder / f"{section.name}.png", section.figure(kept) if kept else _empty_figure())
    rows = [attrs.asdict(row) for row in section.rows(kept)]
    about = {name: _policy_info(load_robot(study.robot), path) for name, path in study.policies.items()}
    content = {"made_with": provenance(section, study), "policies": about, "rows": rows}
    write_json(folder / f"{section.name}.json", {"schema": SCHEMA, **content})


def _empty_figure() -> Figure:
    """Figure of a section without records."""
    figure = Figure(figsize=(4.0, 1.0))
    figure.text(0.5, 0.5, "every robot fell before there was anything to show", ha="center", va="center")
    return figure


def _policy_info(robot: Robot, path: Path) -> dict[str, Any]:
    """File name, command limits and recipe of a policy."""
    metadata = PolicyFile(robot, path).metadata
    limits = {axis: list(bounds) for axis, bounds in metadata.command_limits.items()}
    return {"file": path.name, "command_limits": limits, "recipe": metadata.recipe}


def write_records(path: Path, records: Sequence[Record]) -> None:
    """Write records as CSV: numbers with six significant digits, None as an empty field.

    Args:
        path: The file.
        records: The records.
    """
    with atomic_write(path) as draft, draft.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(records[0]) if records else [], lineterminator="\n")
        writer.writeheader()
        for record in records:
            writer.writerow({name: _text(value) for name, value in record.items()})


def _text(value: Any) -> str:
    """Value as text of a CSV field."""
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def read_records(path: Path) -> list[Record]:
    """Read records from a CSV file of `write_records`.

    Args:
        path: The file.

    Returns:
        The records.
    """
    with path.open(newline="") as file:
        return [{name: _value(text) for name, text in line.items()} for line in csv.DictReader(file)]


def _value(text: str) -> Any:
    """Value of a CSV field: int, float, text, or None if empty."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text or None


def write_page(folder: Path, sections: Sequence[Section], robot: str) -> None:
    """Write the page with all sections whose files are in the folder.

    Args:
        folder: Folder of the files.
        sections: Sections in the order of the page.
        robot: Name of the robot, or its folder; the paper's is the AlienGo.
    """
    title = load_robot(robot).title
    there = [section for section in sections if (folder / f"{section.name}.json").exists()]
    rows = {section: section.rows(read_records(folder / f"{section.name}.csv")) for section in there}
    lines = [
        f"# Section 4 of the paper, in simulation: {title}",
        "",
        "Written by `quadvel paper` (`make paper`); do not edit. The paper's values are those of its CRL-EAM, on an AlienGo; ours",
        f"those of a simulated {title} with actuator model, sensor noise, delays and the estimator in the loop. In brackets: ours",
        "minus the paper's. Figures that fall short stand here as they are.",
        "",
        *markdown_table(
            [attrs.evolve(r, what=f"{s.name}: {r.what}") for s in there for r in rows[s] if r.key]
        ),
        "",
    ]
    for section in there:
        lines += _chapter(section, rows[section], read_json(folder / f"{section.name}.json"))
    with atomic_write(folder / PAGE_FILE) as draft:
        draft.write_text("\n".join(lines))


def _chapter(section: Section, rows: Sequence[Row], content: Mapping[str, Any]) -> list[str]:
    """Lines of a section on the page."""
    made = content["made_with"]
    policies = ", ".join(f"{name} ({digest})" for name, digest in made["policies"].items())
    seeds = "1 seed" if made["seeds"] == 1 else f"{made['seeds']} seeds"
    return [
        f"## {section.title}",
        "",
        section.method,
        "",
        *markdown_table(rows),
        "",
        f"![{section.title}]({section.name}.png)",
        "",
        f"[{section.name}.csv]({section.name}.csv); {policies}; {made['estimator']} estimator; {seeds} where it counts.",
        "",
    ]


def markdown_table(rows: Sequence[Row]) -> list[str]:
    """Format rows as a Markdown table with a column for each policy.

    Args:
        rows: The rows.

    Returns:
        Lines of the table.
    """
    policies = distinct([{"policy": name} for row in rows for name in row.ours], "policy")
    lines = [
        f"| | paper | {' | '.join(policies)} |",
        f"|---|{'---|' * (1 + len(policies))}",
    ]
    for row in rows:
        what = f"{row.what}, {row.unit}" if row.unit else row.what
        cells = [_cell(row, row.ours.get(name)) for name in policies]
        lines.append(f"| {what} | {_number(row, row.paper)} | {' | '.join(cells)} |")
    return lines


def _cell(row: Row, value: float | None) -> str:
    """Our value, with its difference from the paper's in brackets."""
    if value is None or row.paper is None:
        return _number(row, value)
    return f"{_number(row, value)} ({value - row.paper:+.{row.digits}f})"


def _number(row: Row, value: float | None) -> str:
    """Number with the decimals of the row; a dash for None."""
    return "–" if value is None else f"{value:.{row.digits}f}"
