"""Blending of commands and moves between postures: torques change without a jump."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_description.kinematics import foot_positions, rotate
from quadvel_description.state import MODE_DAMPING, JointCommand, RobotState
from quadvel_policy.modes import ModeInput, Posture, blend, vertical_offset
from tests.helpers.robots import ALIENGO


def torque(command: JointCommand, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    return command.tau + command.kp * (command.q - q) + command.kd * (command.dq - dq)


def some_command(rng: np.random.Generator) -> JointCommand:
    q, dq, tau = rng.normal(size=(3, 12))
    return JointCommand(q=q, dq=dq, tau=tau, kp=rng.uniform(0, 100, 12), kd=rng.uniform(0, 5, 12))


def tick_at(elapsed: float, q: np.ndarray, previous: JointCommand) -> ModeInput:
    zeros = np.zeros(12)
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    state = RobotState(elapsed, 0, q, zeros, zeros, upright, np.zeros(3), np.zeros(3), np.zeros(4))
    return ModeInput(elapsed, state, np.zeros(3), np.zeros(4), previous)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_blend_asks_for_the_mean_torque_wherever_the_joints_are(share: float) -> None:
    rng = np.random.default_rng(0)
    a, b = some_command(rng), some_command(rng)
    for q, dq in rng.normal(size=(5, 2, 12)):
        mean = (1 - share) * torque(a, q, dq) + share * torque(b, q, dq)
        np.testing.assert_allclose(torque(blend(a, b, share), q, dq), mean, atol=1e-9)


def test_a_blend_from_damping_fades_the_gains_in() -> None:
    b = some_command(np.random.default_rng(1))
    half = blend(JointCommand.damping(4.0), b, 0.5)
    assert half.mode != MODE_DAMPING
    np.testing.assert_allclose(half.kp, b.kp / 2)
    np.testing.assert_allclose(half.q, b.q)
    np.testing.assert_allclose(half.kd, 2.0 + b.kd / 2)


def test_a_blend_of_two_commands_without_gains_is_finite() -> None:
    nothing = blend(JointCommand(), JointCommand(q=ALIENGO.nominal_q.copy()), 0.5)
    np.testing.assert_array_equal(nothing.q, ALIENGO.nominal_q)
    np.testing.assert_array_equal(nothing.kp, np.zeros(12))


def test_a_posture_starts_with_the_torque_of_the_mode_before() -> None:
    rng = np.random.default_rng(2)
    before = some_command(rng)
    q = rng.normal(size=12)
    posture = Posture(ALIENGO, [(1.0, ALIENGO.nominal_q)], kp=100.0, kd=3.0)
    posture.enter(tick_at(0.0, q, before))
    first = posture.tick(tick_at(0.0, q, before))
    np.testing.assert_allclose(first.kp * (first.q - q), before.kp * (before.q - q) + before.tau, atol=1e-9)


def test_a_posture_passes_its_waypoints_at_rest_and_holds_the_last() -> None:
    posture = Posture(ALIENGO, [(0.8, ALIENGO.lie_q), (1.2, ALIENGO.nominal_q)], kp=100.0, kd=3.0)
    start = np.zeros(12)
    posture.enter(tick_at(0.0, start, JointCommand.damping()))
    for elapsed, expected in (
        (0.0, start),
        (0.8, ALIENGO.lie_q),
        (2.0, ALIENGO.nominal_q),
        (9.0, ALIENGO.nominal_q),
    ):
        command = posture.tick(tick_at(elapsed, start, JointCommand.damping()))
        np.testing.assert_allclose(command.q, expected, atol=1e-12)
        np.testing.assert_allclose(command.dq, 0.0, atol=1e-12)
    assert not posture.is_finished(1.99)
    assert posture.is_finished(2.0)


@pytest.mark.parametrize("axis", [(1.0, 0.0), (0.0, 1.0), (0.6, -0.8)])
def test_on_a_slope_a_posture_keeps_the_feet_below_the_trunk(axis: tuple[float, float]) -> None:
    tilt = 0.25
    state = tick_at(0.0, ALIENGO.nominal_q, JointCommand.damping()).state
    state.quaternion = np.array([np.cos(tilt / 2), *(np.sin(tilt / 2) * np.array(axis)), 0.0])
    posture = Posture(ALIENGO, [(1.0, ALIENGO.nominal_q)], kp=100.0, kd=3.0)
    feet = foot_positions(ALIENGO, posture.final_posture(state))
    np.testing.assert_allclose(feet[:, 2], -0.4, atol=1e-4)  # no leg shorter than before
    middle = rotate(state.quaternion, feet.mean(axis=0))
    np.testing.assert_allclose(middle[:2], 0.0, atol=1e-9)


def test_a_posture_leans_by_at_most_20_degrees() -> None:
    state = tick_at(0.0, ALIENGO.nominal_q, JointCommand.damping()).state
    state.quaternion = np.array([np.cos(0.5), 0.0, np.sin(0.5), 0.0])  # 1 rad
    assert np.linalg.norm(vertical_offset(state)) == pytest.approx(np.tan(0.35))


def test_the_speed_of_a_posture_is_the_derivative_of_its_path() -> None:
    posture = Posture(ALIENGO, [(0.8, ALIENGO.lie_q), (1.2, ALIENGO.nominal_q)], kp=100.0, kd=3.0)
    posture.enter(tick_at(0.0, np.zeros(12), JointCommand.damping()))

    def at(elapsed: float) -> JointCommand:
        return posture.tick(tick_at(elapsed, np.zeros(12), JointCommand.damping()))

    for elapsed in np.linspace(0.05, 1.95, 20):
        slope = (at(elapsed + 1e-5).q - at(elapsed - 1e-5).q) / 2e-5
        np.testing.assert_allclose(at(elapsed).dq, slope, atol=1e-4)
