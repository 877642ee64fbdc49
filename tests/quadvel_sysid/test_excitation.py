"""Excitation motions, and proposals which one to record next."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from quadvel_description.kinematics import foot_positions
from quadvel_sysid import excitation
from quadvel_sysid.excitation import EXCITATIONS, MAX_TORQUE_SHARE, PERIOD_S, FootLifting, propose
from tests.helpers.robots import ALIENGO


def eq9(t: float, leg: int) -> float:
    """Height of a foot (m) below its hip, as the paper prints it."""
    k = (8 * t + (0, 2, 2, 0)[leg]) % 4
    if k < 1:
        return 0.1 * (-2 * k**3 + 3 * k**2) - 0.4
    if k < 2:
        return 0.1 * (2 * k**3 - 9 * k**2 + 12 * k - 4) - 0.4
    return -0.4


def test_foot_lifting_follows_equation_9() -> None:
    targets = FootLifting(ALIENGO, seconds=1.2).targets()
    for row in (0, 37, 125, 180, 250, 333, 501, 870, 1199):
        feet = foot_positions(ALIENGO, targets[row]) - ALIENGO.legs.hips
        np.testing.assert_allclose(feet[:, 2], [eq9(row * PERIOD_S, leg) for leg in range(4)], atol=1e-9)
        np.testing.assert_allclose(feet[:, 0], 0.0, atol=1e-9)


@pytest.mark.parametrize("name", EXCITATIONS)
def test_every_motion_stays_within_the_joints_range_and_speed(name: str) -> None:
    targets = EXCITATIONS[name](ALIENGO, seconds=6.0).targets()
    assert targets.shape == (6000, 12)
    assert (targets >= ALIENGO.command_lower).all()
    assert (targets <= ALIENGO.command_upper).all()
    assert (np.abs(np.diff(targets, axis=0)) <= ALIENGO.velocity_limit * PERIOD_S + 1e-12).all()


@pytest.mark.parametrize("name", ["chirp", "steps", "creep", "solo"])
def test_motions_in_the_air_move_every_joint_by_itself(name: str) -> None:
    speed = np.diff(EXCITATIONS[name](ALIENGO, seconds=12.0).targets(), axis=0)
    assert (speed.std(axis=0) > 0.0).all()
    correlation = np.corrcoef(speed.T) - np.eye(12)
    assert np.abs(correlation).max() < 0.98


def test_solo_moves_one_joint_at_a_time() -> None:
    moving = np.abs(np.diff(EXCITATIONS["solo"](ALIENGO, seconds=12.0).targets(), axis=0)) > 1e-6
    assert moving.sum(axis=1).max() == 1
    assert moving.any(axis=0).all()


def test_target_requests_at_most_its_share_of_the_torque_limit() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        q, dq, target = rng.normal(0, 1, 12), rng.normal(0, 10, 12), rng.normal(0, 3, 12)
        asked = 30.0 * (excitation.limit_torque(ALIENGO, target, q, dq, 30.0, 0.5) - q) - 0.5 * dq
        assert (np.abs(asked) <= MAX_TORQUE_SHARE * ALIENGO.torque_limit + 1e-9).all()
    calm = ALIENGO.nominal_q + 0.1
    np.testing.assert_array_equal(
        excitation.limit_torque(ALIENGO, calm, ALIENGO.nominal_q, np.zeros(12), 30.0, 0.5), calm
    )


def report(*names: str, depends_on: tuple[str, ...] = ()) -> dict[str, Any]:
    effects = [{"name": names[0], "indistinguishable": list(names[1:])}] if names else []
    verdict = "structured" if depends_on else "white"
    unexplained = {"verdict": verdict, "depends_on": list(depends_on)}
    return {"joints": ["FR_hip_joint"], "effects": effects, "unexplained": unexplained}


def test_a_proposal_names_the_robot_and_moves_no_robot_for_a_bench() -> None:
    content = report("thermal_drift", "supply_sag")
    assert "--robot" not in propose(content)[0].command
    assert propose(content | {"robot": "go2"})[0].command.endswith(" --robot go2")
    assert propose(content, "out/third")[0].command.endswith(" --robot out/third")
    assert not propose(content | {"joints": ["elbow"]})[0].command.startswith("quadvel")


def test_distinguished_effect_needs_no_further_excitation() -> None:
    assert propose(report("coulomb_friction")) == []
    assert propose(report()) == []


@pytest.mark.parametrize(
    ("names", "motions"),
    [
        (("coulomb_friction", "stribeck_friction"), ["creep"]),
        (("first_order_lag", "velocity_filter"), ["chirp"]),
        (("torque_saturation", "torque_speed_limit"), ["steps"]),
        (("coulomb_friction", "load_dependent_friction"), ["creep", "sweep"]),
        (("cross_coupling", "an effect of another package"), ["solo", "steps"]),
    ],
)
def test_indistinguishable_effects_get_the_excitations_that_separate_them(
    names: tuple[str, ...], motions: list[str]
) -> None:
    proposals = propose(report(*names))
    assert [one.excitation for one in proposals] == motions
    assert all(one.separates == names for one in proposals)


def test_signals_of_the_residual_are_excited_and_proposals_are_merged() -> None:
    signals = ("FR_thigh_joint/dq", "tau@history", "q", "FL_calf_joint/q")
    proposals = propose(report("stribeck_friction", "coulomb_friction", depends_on=signals))
    assert [one.excitation for one in proposals] == ["creep", "solo", "chirp"]
    assert proposals[0].separates == ("stribeck_friction", "coulomb_friction", "what depends on q")


def test_slow_effects_need_a_long_recording() -> None:
    (proposal,) = propose(report("thermal_drift", "supply_sag"))
    assert proposal.command == "quadvel excite sweep --seconds 300"
