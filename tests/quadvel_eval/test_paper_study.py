"""Running and keeping sections, with a section that needs no robot."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
import pytest

from quadvel_eval.paper import files, study
from quadvel_eval.paper.cli import paper_command
from quadvel_eval.paper.section import Study
from quadvel_eval.pool import Call
from quadvel_policy.policy_file import SHIPPED_POLICY
from tests.helpers.sections import Powers


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "SECTIONS", (Powers(),))


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    def one_by_one(calls: Sequence[Call], cluster: str | None) -> Iterator[tuple[int, Any]]:
        return enumerate(function(*arguments) for function, *arguments in calls)

    monkeypatch.setattr(study, "run_in_parallel", one_by_one)


TWO = Study(policies={"a": SHIPPED_POLICY, "b": SHIPPED_POLICY})


def test_a_section_leaves_csv_picture_json_and_the_page(tmp_path: Path, page: None) -> None:
    heard: list[study.Progress] = []
    assert study.run_sections(TWO, [Powers()], tmp_path, report_progress=heard.append) == ["powers"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "README.md",
        "powers.csv",
        "powers.json",
        "powers.png",
    ]
    assert (tmp_path / "powers.csv").read_text().splitlines()[:2] == ["policy,k,value,none", "a,0,1,"]
    assert "| largest, m | 5.0 | 4.0 (-1.0) | 4.0 (-1.0) |" in (tmp_path / "README.md").read_text()
    assert [progress.done for progress in heard] == [1, 2, 3, 4, 5, 6]
    assert [progress.completed for progress in heard] == [None] * 5 + ["powers"]


def test_a_finished_section_is_kept_until_a_rerun_or_a_change(
    tmp_path: Path, page: None, in_this_process: None
) -> None:
    study.run_sections(TWO, [Powers()], tmp_path)
    assert study.run_sections(TWO, [Powers()], tmp_path) == []
    assert study.run_sections(TWO, [Powers()], tmp_path, rerun=True) == ["powers"]
    assert study.run_sections(attrs.evolve(TWO, seeds=1), [Powers()], tmp_path) == ["powers"]
    assert study.run_sections(TWO, [Powers(count=4)], tmp_path) == ["powers"]


def test_another_network_repeats_a_section(tmp_path: Path) -> None:
    other = tmp_path / "other.onnx"
    other.write_bytes(SHIPPED_POLICY.read_bytes() + b"\0")
    first, second = (files.provenance(Powers(), Study(policies={"a": p})) for p in (SHIPPED_POLICY, other))
    assert first["policies"] != second["policies"]
    assert first == json.loads(json.dumps(first))


def test_records_come_back_from_the_csv_as_they_went_in(tmp_path: Path) -> None:
    records = [{"policy": "a", "k": 3, "value": 0.25, "none": None}]
    files.write_records(tmp_path / "records.csv", records)
    assert files.read_records(tmp_path / "records.csv") == records


@pytest.mark.parametrize("text", ["nowhere.onnx", "=file", "name="])
def test_a_policy_without_name_or_file_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ValueError, match="NAME=FILE"):
        paper_command(tmp_path / "out", policy=[text])
    assert not (tmp_path / "out").exists()


def test_an_unknown_section_is_refused_by_its_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'figure13', expected one of identification, gait, "):
        paper_command(tmp_path / "out", only=["figure13"])


def test_an_interrupted_section_keeps_the_old_files(
    tmp_path: Path, page: None, in_this_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    study.run_sections(TWO, [Powers()], tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def stopped(calls: Sequence[Call], cluster: str | None) -> Iterator[tuple[int, Any]]:
        yield 0, (1, 0.1)
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "run_in_parallel", stopped)
    with pytest.raises(KeyboardInterrupt):
        study.run_sections(TWO, [Powers()], tmp_path, rerun=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
