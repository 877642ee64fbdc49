"""Tests of the blind generator against closed forms and its specification."""

import ast
from pathlib import Path

import numpy as np
import pytest

from benchmarks.identification import hidden
from benchmarks.identification.hidden.cases import GROUP_OF, make_case
from benchmarks.identification.hidden.motion import STANCE, foot_height, ground_torque, leg_angles
from benchmarks.identification.hidden.plant import arrivals

SOURCES = sorted(Path(hidden.__file__).parent.glob("*.py"))


def _asked(log, truth):
    """Eq. 1 on the log with the true parameters: the torque of each sample, without effects."""
    then = log["t"] - truth["output_delay_ms"] / 1000
    sent = np.searchsorted(log["t_cmd"], then - truth["input_delay_ms"] / 1000 + 1e-9, side="right") - 1
    held = log["q_des_cmd"][np.maximum(sent, 0)]
    q, dq = (
        np.stack([np.interp(then, log["t"], row) for row in log[name].T], axis=1) for name in ("q", "dq")
    )
    torque = (truth["kp"] + truth["delta_kp"]) * (held - q) - (truth["kd"] + truth["delta_kd"]) * dq
    return np.where(sent[:, None] < 0, log["tau"], torque)[40:], log["tau"][40:]


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.name)
def test_the_generator_imports_nothing_of_the_product(source):
    for node in ast.walk(ast.parse(source.read_text())):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        assert not [name for name in names if name.startswith("quadvel")]


@pytest.mark.parametrize("index", [0, 1, 2, 3])
def test_without_an_effect_the_torque_is_equation_1_and_noise_of_the_stated_size(index):
    case = make_case("none", index)
    asked, measured = _asked(case.log, case.truth)
    assert np.mean((measured - asked) ** 2) == pytest.approx(case.truth["floor"], rel=0.05)


def test_table_4_is_the_papers_robot_on_equation_9():
    case = make_case("table_4", 0)
    asked, measured = _asked(case.log, case.truth)
    assert case.log["tau"].shape[1] == 12
    assert case.log["t"][-1] - case.log["t"][0] == pytest.approx(5.0, abs=0.01)
    assert np.mean((measured - asked) ** 2) == pytest.approx(0.066, rel=0.03)
    assert case.holdout is not None


def test_coulomb_friction_is_a_torque_of_constant_size_against_the_motion():
    for index in range(3):
        case = make_case("coulomb_friction", index)
        effect = case.truth["effects"][0]
        asked, measured = _asked(case.log, case.truth)
        moved = np.array(case.log["dq"])[40:]
        for place, joint in enumerate(case.truth["joints"]):
            fast = np.abs(moved[:, place]) > 0.6
            lost = np.mean(((asked - measured) * np.sign(moved))[fast, place])
            assert lost == pytest.approx(
                effect["params"]["c"] if joint in effect["joints"] else 0.0, abs=0.06
            )


SEEN_ALWAYS = ("coulomb_friction", "backlash", "mains_hum")
"""Kinds that are made in every run; making all of them takes a minute of two cores"""
KINDS = [kind for kind, group in GROUP_OF.items() if group in ("alone", "outside")]


@pytest.mark.parametrize(
    "kind", [kind if kind in SEEN_ALWAYS else pytest.param(kind, marks=pytest.mark.long) for kind in KINDS]
)
def test_an_effect_is_worth_between_a_third_and_some_times_the_noise(kind):
    case = make_case(kind, 1)
    worth, noise = case.truth["worth"]["left"], case.truth["noise_var"]
    asked, measured = _asked(case.log, case.truth)
    assert 0.3 * noise <= worth <= 6 * noise
    # The fitted model has a smaller error than the true one; the effect's size uses some of the rows.
    assert np.mean((measured - asked) ** 2) >= 0.9 * (worth + noise)
    assert np.all(np.isfinite(case.log["q"]))
    assert np.abs(case.log["dq"]).max() < 30


@pytest.mark.parametrize("kind", ["pair", pytest.param("triple", marks=pytest.mark.long)])
def test_of_several_effects_each_is_worth_a_third_of_the_noise_beside_the_others(kind):
    case = make_case(kind, 1)
    assert len(case.truth["effects"]) == {"pair": 2, "triple": 3}[kind]
    assert min(case.truth["worth"]["each"]) >= 0.3 * case.truth["noise_var"]


def test_the_same_seed_gives_the_same_log_and_another_seed_another():
    first, again, other = make_case("cogging", 3, 5), make_case("cogging", 3, 5), make_case("cogging", 3, 6)
    assert first.truth == again.truth
    assert all(np.array_equal(first.log[name], again.log[name]) for name in first.log)
    assert first.truth["noise_var"] != other.truth["noise_var"]


@pytest.mark.long
def test_speed_proportional_friction_is_never_on_all_joints():
    for index in range(4):
        case = make_case("viscous_friction", index)
        assert len(case.truth["effects"][0]["joints"]) < len(case.truth["joints"])


def test_the_log_holds_nothing_but_what_the_format_names(tmp_path):
    case = make_case("thermal_drift", 0)
    allowed = {
        "t",
        "q",
        "dq",
        "tau",
        "t_cmd",
        "q_des_cmd",
        "kp",
        "kd",
        "joint_names",
        "temperature",
        "voltage",
    }
    (path,) = case.save(tmp_path)
    with np.load(path, allow_pickle=False) as saved:
        assert set(saved.files) <= allowed


def test_a_command_counts_from_its_arrival_until_the_next_arrives():
    assert arrivals(np.array([0, 4, 8]), 3, 14).tolist() == [0] * 7 + [1] * 4 + [2] * 3
    late = arrivals(np.array([0, 4, 8]), np.array([3, 9, 3]), 14)
    assert late.tolist() == [0] * 11 + [2] * 3  # a command that arrives after a newer one is ignored


def test_foot_height_follows_equation_9():
    assert foot_height(np.array([0.0, 0.5, 1.0, 1.5, 2.0, 3.5])) == pytest.approx(
        [-0.4, -0.35, -0.3, -0.35, -0.4, -0.4]
    )


def test_inverse_kinematics_gives_the_stance_at_40_cm():
    angles = leg_angles(np.zeros(1), np.zeros(1), np.full(1, -0.4))
    assert angles[0] == pytest.approx(STANCE, abs=1e-3)


def test_ground_torque_is_the_work_of_the_force():
    force, step = np.array([[12.0, 0.0, 80.0]]), 1e-6
    x, z = np.array([0.05]), np.array([-0.37])
    torque = ground_torque(leg_angles(x, 0 * x, z), force)[0]
    for dx, dz in ((step, 0.0), (0.0, step)):
        turned = (leg_angles(x + dx, 0 * x, z + dz) - leg_angles(x, 0 * x, z))[0]
        assert torque[1:] @ turned[1:] == pytest.approx(force[0] @ [dx, 0.0, dz], rel=1e-3)
