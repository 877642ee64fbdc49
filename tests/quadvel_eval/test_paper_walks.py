"""Short walks of the paper's sections, with the shipped networks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from quadvel_eval.grid import Cell
from quadvel_eval.paper import conditions, stance, sustained, symmetry
from quadvel_eval.paper.conditions import walk_under
from quadvel_eval.paper.estimator import Estimator
from quadvel_eval.paper.gait import Gait
from quadvel_eval.paper.identification import record_foot_lifting
from quadvel_eval.paper.letters import Letters
from quadvel_eval.paper.section import Row, Section, Study
from quadvel_eval.paper.stance import Stance
from quadvel_eval.paper.steps import Steps
from quadvel_eval.paper.sustained import Sustained
from quadvel_eval.paper.symmetry import Symmetry
from quadvel_policy.policy_file import SHIPPED_POLICY
from quadvel_sysid.data.plain_model import fit_eam
from quadvel_sysid.data.signals import Samples
from tests.helpers.robots import ALIENGO

ONE = Study(seeds=1)


def rows(section: Section) -> Sequence[Row]:
    """Run a section in this process and return its table."""
    answers: list[tuple[dict[str, Any], Any]] = []
    for job in section.jobs(ONE):
        function, *arguments = job.call
        answers.append((job.labels, function(*arguments)))
    records = section.to_records(answers)
    section.figure(records)
    return section.rows(records)


def ours(section: Section) -> dict[str, float | None]:
    """Values of the shipped policy, by row."""
    return {row.what: row.ours[SHIPPED_POLICY.stem] for row in rows(section)}


def test_a_ramp_ends_at_its_top() -> None:
    found = ours(Gait(top=0.5, slope=0.5, hold=1.5))
    assert found["velocity at the end of the ramp"] == pytest.approx(0.5, abs=0.2)
    assert found["contact ratio, standing"] == pytest.approx(1.0, abs=0.05)


def test_the_robot_follows_a_stroke() -> None:
    found = ours(Letters(strokes=(((0.5, 0.0, 0.0), 1.5),)))
    assert found["largest deviation"] < 0.4


def test_a_sustained_velocity_is_near_its_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sustained, "HOLD_TIME_S", 2.0)
    monkeypatch.setattr(sustained, "EVALUATED_TIME_S", 1.0)
    found = ours(Sustained(shares=(0.3,), directions=("left",)))
    assert found["left: reached"] == pytest.approx(found["left: largest command that was tried"], abs=0.15)
    for drive in ("fastest joint, share of its drive's speed", "largest torque, share of its drive's"):
        assert 0.1 < found[f"left: {drive}"] < 1.0


def test_a_walk_has_gait_cycles_on_all_legs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(symmetry, "WALK_DURATION_S", 3.0)
    monkeypatch.setattr(symmetry, "SETTLING_TIME_S", 1.0)
    assert 0.0 < ours(Symmetry(speeds=(0.8,)))["asymmetry at 0.8 m/s"] < 0.8


def test_short_episodes_of_random_commands_end_on_the_feet_or_at_a_time() -> None:
    section = Steps(episodes=2, seconds=1.0)
    found = ours(section)
    assert found["episodes"] == 2
    assert found["episodes that end in a fall"] in (0.0, 50.0, 100.0)


def test_a_robot_that_stands_drifts_little(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stance, "WALK_BEFORE_STANCE", [((0.5, 0.0, 0.0), 0.6)])
    found = ours(Stance(seconds=1.0))
    assert found["largest drift in 30 s"] < 5.0
    assert found["joint speed over that of constant targets"] > 0.0
    assert found["whether one fell"] == 0.0


def test_both_estimators_are_evaluated_on_the_same_walks() -> None:
    found = ours(Estimator(seconds=2.5, grounds=("flat",)))
    for name in ("learned", "kalman"):
        assert 0.0 < found[f"flat ground, {name}: RMSE of the worst axis"] < 0.3


def test_a_push_comes_while_the_robot_walks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conditions, "COMMAND_DURATION_S", 2.1)
    setup, cell = ONE.setup(SHIPPED_POLICY.stem), Cell((0.3, 0.0, 0.0), 0)
    assert walk_under(setup, cell, (0.0, 900.0, 0.0)).segment is None
    assert walk_under(setup, cell, (0.0, 10.0, 0.0)).segment is not None


def test_eq_9_gives_back_the_gains_of_the_drives() -> None:
    log = record_foot_lifting(ALIENGO, seed=0, seconds=2.0)
    found = fit_eam(Samples.of([log]), np.ones(log.q.shape, bool))
    assert 30.0 * (found.gains[0, 0] - 1.0) == pytest.approx(-0.706, abs=0.05)
    assert found.mse == pytest.approx(0.066, rel=0.05)
    assert 0.007 < found.input_delay[0] + found.output_delay[0] <= 0.0081
