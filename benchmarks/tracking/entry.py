"""Entries of the tracking benchmark: figures of one policy, and the table of all entries.

The figures are those of the sections of `quadvel paper`, at three sizes. An entry is a folder with
the CSV, picture and JSON file of each section, and `entry.json` with the rows of the table, the
seeds, and what the entry was made with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import attrs

from benchmarks.provenance import last_commit, library_versions
from quadvel_eval.paper.conditions import COMMANDS
from quadvel_eval.paper.energy import Energy
from quadvel_eval.paper.files import markdown_table, provenance, read_records
from quadvel_eval.paper.jitter import Jitter
from quadvel_eval.paper.letters import LETTERS, Letters
from quadvel_eval.paper.robustness import Robustness
from quadvel_eval.paper.section import Row, Section, Study
from quadvel_eval.paper.study import Progress, run_sections
from quadvel_eval.paper.sustained import Sustained
from quadvel_eval.paper.tracking import Tracking
from quadvel_eval.report import read_json, write_json

SCHEMA = 1
ENTRY_FILE = "entry.json"
JUDGED_CODE = ("src", "benchmarks/tracking")
"""Folders whose last commit an entry names."""
LIBRARIES = ("quadvel-core", "mujoco", "numpy", "onnxruntime")


@attrs.frozen
class Size:
    """One size of the benchmark.

    Attributes:
        seeds: Runs of each walk, with seeds 0, 1, ...
        sections: What is measured.
    """

    seeds: int
    sections: tuple[Section, ...]


SIZES = {
    "tiny": Size(
        1,
        (
            Tracking(grids=("tiny",)),
            Robustness(groups=("push",), commands=COMMANDS[:1]),
            Sustained(shares=(1.0,), directions=("forward",)),
            Letters(strokes=LETTERS[:2]),
            Jitter(speeds=(1.0,)),
            Energy(speeds=(1.0,), rates=(1.0,)),
        ),
    ),
    "small": Size(
        1,
        (
            Tracking(grids=("quick",)),
            Robustness(),
            Sustained(shares=(0.8, 1.0)),
            Letters(),
            Jitter(),
            Energy(speeds=(0.5, 1.0, 2.0), rates=(0.5, 1.0)),
        ),
    ),
    "large": Size(3, (Tracking(), Robustness(), Sustained(), Letters(), Jitter(), Energy())),
}
"""Sizes: for tests, for two cores, and for a cluster."""


def make_entry(
    study: Study,
    size: str,
    folder: Path,
    cluster: str | None = None,
    report_progress: Callable[[Progress], None] = lambda progress: None,
) -> dict[str, Any]:
    """Measure one policy, and write its entry. Finished sections of an interrupted run are kept.

    Args:
        study: One policy with the name of the entry, and the estimator in the loop.
        size: Key of SIZES.
        folder: Folder of the entry.
        cluster: Address of a Dask scheduler; None for the cores of this machine.
        report_progress: Called after each walk.

    Returns:
        Content of `entry.json`.
    """
    sections = SIZES[size].sections
    (name,) = study.policies
    file = folder / ENTRY_FILE
    seconds = read_json(file)["core_s"] if file.exists() else {}

    def keep_time(progress: Progress) -> None:
        if progress.completed:
            seconds[progress.completed] = round(progress.seconds, 1)
        report_progress(progress)

    run_sections(study, sections, folder, cluster=cluster, report_progress=keep_time)
    made_with = provenance(sections[0], study)
    entry = {
        "schema": SCHEMA,
        "name": name,
        "robot": study.robot,
        "size": size,
        "seeds": list(range(study.seeds)),
        "policy": made_with["policies"][name],
        "estimator": study.estimator,
        "estimator_file": made_with["estimator_file"],
        "commit": last_commit(*JUDGED_CODE),
        "versions": library_versions(LIBRARIES),
        "core_s": seconds,
        "rows": [attrs.asdict(row) for row in _key_rows(folder, sections)],
    }
    write_json(file, entry)
    return entry


def _key_rows(folder: Path, sections: Sequence[Section]) -> list[Row]:
    """Most important figures of each section."""
    return [
        attrs.evolve(row, what=f"{section.name}: {row.what}")
        for section in sections
        for row in section.rows(read_records(folder / f"{section.name}.csv"))
        if row.key
    ]


def read_entries(folder: Path) -> list[dict[str, Any]]:
    """Read all entries of a folder.

    Args:
        folder: Folder with one folder for each entry.

    Returns:
        Contents of `entry.json`, sorted by name.

    Raises:
        ValueError: A file has another schema, or its robot, size or seeds differ from the first one's.
    """
    files = sorted(folder.glob(f"*/{ENTRY_FILE}"))
    entries = [read_json(file) for file in files]
    for file, entry in zip(files, entries, strict=True):
        for field, expected in {"schema": SCHEMA, **_common(entries[0])}.items():
            if entry.get(field) != expected:
                raise ValueError(f"{file}: {field}: found {entry.get(field)}, expected {expected}")
    return entries


def _common(entry: dict[str, Any]) -> dict[str, Any]:
    """What all entries of a table have in common."""
    return {field: entry.get(field) for field in ("robot", "size", "seeds")}


def entries_table(entries: Sequence[dict[str, Any]]) -> str:
    """Format entries as Markdown: one table, and what each entry was made with.

    Args:
        entries: Contents of `entry.json`, of one robot, size and set of seeds.

    Returns:
        The text.
    """
    rows: dict[str, Row] = {}
    for row in (Row(**row) for entry in entries for row in entry["rows"]):
        known = rows.get(row.what, row)
        rows[row.what] = attrs.evolve(known, ours={**known.ours, **row.ours})
    lines = [*markdown_table(list(rows.values())), ""]
    lines += [
        "| entry | policy | estimator | commit | minutes of a core | made with |",
        "|---|---|---|---|---|---|",
    ]
    for entry in entries:
        estimator = entry["estimator"]
        if estimator == "learned":
            estimator += f" {entry['estimator_file']}"
        versions = ", ".join(f"{name} {number}" for name, number in entry["versions"].items())
        minutes = sum(entry["core_s"].values()) / 60.0
        cells = (entry["name"], entry["policy"], estimator, entry["commit"], f"{minutes:.1f}", versions)
        lines.append(f"| {' | '.join(cells)} |")
    first = entries[0]
    seeds = ", ".join(map(str, first["seeds"]))
    return "\n".join([f"Robot {first['robot']}, size {first['size']}, seeds {seeds}.", "", *lines])
