"""Entries of the tracking benchmark: made at any size, and read into one table."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
import pytest

from benchmarks.tracking import entry
from quadvel_eval.paper import study
from quadvel_eval.paper.section import Row, Study
from quadvel_eval.pool import Call
from quadvel_policy.policy_file import SHIPPED_POLICY
from tests.helpers.sections import Powers


class KeyPowers(Powers):
    """Its row belongs in the table."""

    def rows(self, records: Sequence[dict[str, Any]]) -> list[Row]:
        return [attrs.evolve(row, key=True) for row in super().rows(records)]


@pytest.fixture
def entries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder with the entries `a` and `b`, without a robot and in this process."""

    def one_by_one(calls: Sequence[Call], cluster: str | None) -> Iterator[tuple[int, Any]]:
        return enumerate(function(*arguments) for function, *arguments in calls)

    monkeypatch.setattr(study, "run_in_parallel", one_by_one)
    monkeypatch.setattr(study, "SECTIONS", (KeyPowers(),))
    monkeypatch.setitem(entry.SIZES, "tiny", entry.Size(1, (KeyPowers(),)))
    for name in "ab":
        entry.make_entry(Study(policies={name: SHIPPED_POLICY}, seeds=1), "tiny", tmp_path / name)
    return tmp_path


def test_all_entries_stand_in_one_table_with_their_policy_seeds_and_versions(entries: Path) -> None:
    text = entry.entries_table(entry.read_entries(entries))
    assert "| | paper | a | b |" in text
    assert "| powers: largest, m | 5.0 | 4.0 (-1.0) | 4.0 (-1.0) |" in text
    assert "Robot aliengo, size tiny, seeds 0." in text
    one = entry.read_entries(entries)[1]
    assert f"| b | {one['policy']} | learned {one['estimator_file']} | {one['commit']} | 0.0 |" in text
    assert f"mujoco {one['versions']['mujoco']}" in text


def test_entries_of_other_seeds_do_not_stand_beside_them(entries: Path) -> None:
    path = entries / "b" / entry.ENTRY_FILE
    path.write_text(json.dumps({**json.loads(path.read_text()), "seeds": [0, 1]}))
    with pytest.raises(ValueError, match=r"b/entry.json: seeds: found \[0, 1\], expected \[0\]"):
        entry.read_entries(entries)


def test_every_size_measures_the_same_and_a_larger_one_walks_more() -> None:
    jobs = {}
    for name, size in entry.SIZES.items():
        one = Study(seeds=size.seeds)
        jobs[name] = sum(len(section.jobs(one)) for section in size.sections)
        assert [section.name for section in size.sections] == [
            section.name for section in entry.SIZES["large"].sections
        ]
    assert jobs["tiny"] < 25 < jobs["small"] < 250 < jobs["large"]
