"""Fault campaign: invalid faults raise, reactions are checked, and a missing guard is detected."""

from __future__ import annotations

import json
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import attrs
import pytest
from typer.testing import CliRunner

from quadvel_bringup.cli import app
from quadvel_eval.faults import campaign as campaigns
from quadvel_eval.faults.campaign import FaultRun, run_campaign, run_case, summarise_cases
from quadvel_eval.faults.cases import CASES, Case
from quadvel_eval.faults.injection import COMPONENTS, KINDS, REASONS_UNSUPPORTED, make_injection
from quadvel_eval.faults.report import markdown, write_campaign
from quadvel_eval.faults.stack import Stack
from quadvel_policy.guards import GUARDS
from quadvel_policy.guards.legs import DriveDoesNotAnswer
from quadvel_policy.guards.states import StateFrozen


def case(name: str) -> Case:
    return next(one for one in CASES if one.name == name)


@cache
def _clock_run() -> FaultRun:
    return run_case("aliengo", case("clock wrong stance"), seed=0)


def clock_run() -> FaultRun:
    """A short run; a copy, which a test may change."""
    return deepcopy(_clock_run())


@pytest.mark.parametrize("component", COMPONENTS)
@pytest.mark.parametrize("kind", KINDS)
def test_an_invalid_combination_raises_with_the_reason(component: str, kind: str) -> None:
    if kind in COMPONENTS[component]:
        assert make_injection(component, kind).kind == kind
        return
    with pytest.raises(
        ValueError,
        match=f"^{component} can't be {kind}: expected one of .*; {REASONS_UNSUPPORTED[component]}$",
    ):
        make_injection(component, kind)


@pytest.mark.parametrize(("component", "kind"), [("wheel", "off"), ("imu", "purple")])
def test_unknown_names_raise(component: str, kind: str) -> None:
    with pytest.raises(ValueError, match="expected one of"):
        make_injection(component, kind)


def test_the_campaign_is_large_and_each_of_its_cases_can_be_injected() -> None:
    kinds = {(one.component, one.kind) for one in CASES}
    assert len(kinds) >= 40
    assert len({one.name for one in CASES}) == len(CASES)
    assert kinds == {(component, kind) for component in COMPONENTS for kind in COMPONENTS[component]}


@pytest.mark.parametrize(
    "name",
    [
        "low_state off stance",
        "low_state stuck walk",
        "encoder wrong lie_down",
        "estimator off walk",
        "controller off stand_up",
    ],
)
def test_the_reaction_is_as_expected(name: str) -> None:
    result = run_case("aliengo", case(name), seed=3)
    assert result.wrong == []
    assert result.torque <= 1.0


@pytest.mark.parametrize(
    ("name", "guard", "sentence"),
    [
        ("low_state stuck stance", StateFrozen, "expected state_frozen"),
        ("torque wrong stance", DriveDoesNotAnswer, "expected drive_does_not_answer"),
    ],
)
def test_a_missing_guard_is_detected(
    monkeypatch: pytest.MonkeyPatch, name: str, guard: Any, sentence: str
) -> None:
    def without(*arguments: Any) -> Stack:
        return Stack(*arguments, guards=tuple(one for one in GUARDS if one is not guard))

    monkeypatch.setattr(campaigns, "Stack", without)
    wrong = "; ".join(run_case("aliengo", case(name), seed=0).wrong)
    assert sentence in wrong


def test_equal_seeds_give_equal_runs() -> None:
    first, again, other = (run_case("aliengo", case("imu stuck walk"), seed) for seed in (1, 1, 2))
    assert attrs.asdict(first) == attrs.asdict(again)
    assert attrs.asdict(first) != attrs.asdict(other)


def test_the_result_is_written_as_file_table_and_picture(tmp_path: Path) -> None:
    runs = [clock_run(), run_case("aliengo", case("imu off stance"), seed=0)]
    runs[0].wrong.append("a test")
    write_campaign(tmp_path, runs)
    kept = json.loads((tmp_path / "faults.json").read_text())
    assert [one["component"] for one in kept["runs"]] == ["clock", "imu"]
    assert [(one["case"], one["as_expected"]) for one in summarise_cases(runs)] == [
        ("imu off stance", 1),
        ("clock wrong stance", 0),
    ]
    assert "| imu off stance | 1 of 1 | attitude_not_unit |" in markdown(kept["cases"])
    assert (tmp_path / "faults.png").stat().st_size > 1000


def test_unknown_cases_raise() -> None:
    with pytest.raises(ValueError, match=r"no case contains 'wheel'.* processor; .*lie_down") as refused:
        run_campaign("aliengo", 1, "wheel")
    assert len(str(refused.value)) < 500


def test_the_command_reports_unexpected_reactions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bad = clock_run()
    bad.wrong.append("it is purple")
    monkeypatch.setattr("quadvel_eval.cli.run_campaign", lambda *_: [bad])
    answer = CliRunner().invoke(app, ["faults", "--out", str(tmp_path)])
    assert answer.exit_code == 1
    assert "0 of 1" in answer.output
    assert "it is purple" in answer.output
