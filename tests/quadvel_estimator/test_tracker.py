"""States on their way to an estimator: order, rate, gaps, resets, and the position that they add up to."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from quadvel_description.state import MODE_DAMPING, MODE_SERVO, RobotState
from quadvel_estimator.tracker import MAX_STALE_STATES, VelocityTracker
from quadvel_nodes.messages import MessageError
from tests.helpers.robots import ALIENGO

State = Callable[..., RobotState]
MOVING = np.ones(12)
"""Speeds of the joints of a robot that is not at rest, rad/s."""


class Scripted:
    """Returns one velocity and remembers its inputs."""

    def __init__(self) -> None:
        self.velocity = np.array([1.0, 0.0, 0.0])
        self.times: list[float] = []
        self.actions: list[NDArray[np.float64]] = []
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1

    def update(
        self, state: RobotState, previous_action: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        self.times.append(state.time)
        self.actions.append(np.asarray(previous_action))
        if not np.isfinite(self.velocity).all():
            raise FloatingPointError("not finite")
        return self.velocity, 0.01 * np.eye(3)


@pytest.fixture
def estimator() -> Scripted:
    return Scripted()


@pytest.fixture
def tracker(estimator: Scripted) -> VelocityTracker:
    return VelocityTracker(estimator, reset_gap=0.1)


def test_states_at_200_hz_are_all_taken(
    tracker: VelocityTracker, estimator: Scripted, standing: State
) -> None:
    times = [5.0 + 0.005 * i for i in range(40)]
    assert all(tracker.process(standing(t)) is not None for t in times)
    assert estimator.times == times


def test_states_at_1_khz_are_taken_at_the_estimator_s_rate(
    tracker: VelocityTracker, estimator: Scripted, standing: State
) -> None:
    for i in range(1000):
        tracker.process(standing(0.001 * i))
    assert len(estimator.times) == pytest.approx(200, abs=1)
    np.testing.assert_allclose(np.diff(estimator.times[1:]), 0.005)


def test_an_old_state_is_refused_and_changes_nothing(
    tracker: VelocityTracker, estimator: Scripted, standing: State
) -> None:
    tracker.process(standing(1.0))
    tracker.process(standing(1.005))
    with pytest.raises(MessageError, match="stamp is 505 ms older than the newest, expected a later one"):
        tracker.process(standing(0.5))
    assert tracker.process(standing(1.010)) is not None
    assert estimator.times == [1.0, 1.005, 1.010]
    assert estimator.resets == 0


def test_a_stamp_that_never_changes_is_refused_for_ever(
    tracker: VelocityTracker, estimator: Scripted, standing: State
) -> None:
    tracker.process(standing(1.0))
    for _ in range(5 * MAX_STALE_STATES):
        with pytest.raises(MessageError):
            tracker.process(standing(1.0))
    assert estimator.resets == 0


def test_time_that_was_set_back_starts_the_estimator_anew(
    tracker: VelocityTracker, estimator: Scripted, standing: State
) -> None:
    tracker.process(standing(100.0))
    for i in range(MAX_STALE_STATES - 1):
        with pytest.raises(MessageError):
            tracker.process(standing(0.005 * i))
    assert tracker.process(standing(0.005 * MAX_STALE_STATES)) is not None
    assert estimator.resets == tracker.restarts == 1
    assert tracker.process(standing(0.005 * (MAX_STALE_STATES + 1))) is not None


def test_a_gap_starts_the_estimator_anew_and_a_short_one_does_not(
    tracker: VelocityTracker, estimator: Scripted, standing: State
) -> None:
    for time in (0.0, 0.005, 0.045):
        tracker.process(standing(time))
    assert estimator.resets == 0
    tracker.process(standing(0.2))
    assert estimator.resets == tracker.restarts == 1


def test_an_estimate_that_is_not_finite_resets_the_estimator(
    tracker: VelocityTracker, estimator: Scripted, standing: State
) -> None:
    estimator.velocity = np.full(3, np.nan)
    with pytest.raises(FloatingPointError):
        tracker.process(standing(0.0))
    assert estimator.resets == 1


def test_the_position_is_what_the_velocity_adds_up_to(
    tracker: VelocityTracker, estimator: Scripted, standing: State
) -> None:
    """A quarter circle: at heading psi the velocity (1, 0, 0) of the body points to (cos psi, sin psi, 0)."""
    estimator.velocity = np.array([1.0, 0.0, 0.0])
    steps = 400
    for i in range(steps + 1):
        half = 0.5 * (np.pi / 2) * i / steps
        estimate = tracker.process(
            standing(0.005 * i, dq=MOVING, quaternion=np.array([np.cos(half), 0.0, 0.0, np.sin(half)]))
        )
    assert estimate is not None
    radius = 0.005 * steps / (np.pi / 2)
    np.testing.assert_allclose(estimate.position, [radius, radius, 0.0], atol=0.005)
    np.testing.assert_allclose(estimate.position_deviation, 0.1 * 0.005 * steps)


def test_a_restart_leaves_the_position_where_it_was(tracker: VelocityTracker, standing: State) -> None:
    for i in range(201):
        before = tracker.process(standing(0.005 * i, dq=MOVING))
    after = tracker.process(standing(10.0, dq=MOVING))
    assert before is not None
    assert after is not None
    np.testing.assert_allclose(before.position, [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(after.position, before.position)


def test_the_position_of_a_robot_at_rest_stays_whatever_the_estimate_is(
    tracker: VelocityTracker, standing: State
) -> None:
    rng = np.random.default_rng(0)
    found = [
        tracker.process(standing(0.005 * i, dq=MOVING if i < 100 else 0.1 * rng.standard_normal(12)))
        for i in range(400)
    ]
    estimates = [one for one in found if one is not None]
    assert [one.stays for one in estimates[:100]] == [False] * 100
    assert all(one.stays for one in estimates[300:])
    np.testing.assert_array_equal(estimates[-1].position, estimates[300].position)
    np.testing.assert_array_equal(estimates[-1].position_deviation, estimates[300].position_deviation)
    assert estimates[-1].velocity.tolist() == [1.0, 0.0, 0.0]


def test_the_position_of_a_robot_with_damped_joints_stays(tracker: VelocityTracker, standing: State) -> None:
    for time, mode in ((0.0, MODE_SERVO), (0.005, MODE_DAMPING), (0.01, MODE_DAMPING), (0.015, MODE_SERVO)):
        tracker.set_command(ALIENGO, ALIENGO.nominal_q, mode)
        estimate = tracker.process(standing(time, dq=MOVING))
        assert estimate is not None
        assert estimate.stays == (mode == MODE_DAMPING)
    np.testing.assert_allclose(estimate.position, [0.005, 0.0, 0.0])


def test_a_trunk_that_turns_or_one_joint_that_moves_is_no_rest(
    tracker: VelocityTracker, standing: State
) -> None:
    turning, one_joint = np.array([0.0, 0.0, 0.1]), 0.1 * np.eye(12)[4]
    for change in ({"angular_velocity": turning}, {"dq": one_joint}):
        found = [tracker.process(standing(0.005 * i, **change)) for i in range(200)]
        assert not any(one.stays for one in found if one is not None)
        tracker = VelocityTracker(Scripted())


def test_odometry_starts_at_zero_where_the_robot_was_put_to_another_place(
    tracker: VelocityTracker, standing: State
) -> None:
    for time in (0.0, 0.005, 0.01):
        tracker.process(standing(time))
    tracker.reset_position()
    first = tracker.process(standing(0.015))
    assert first is not None
    assert not first.position.any()
    assert not first.position_deviation.any()


def test_the_estimator_sees_the_targets_in_force(
    tracker: VelocityTracker, estimator: Scripted, standing: State
) -> None:
    tracker.process(standing(0.0))
    tracker.set_command(ALIENGO, ALIENGO.nominal_q + 0.1, MODE_SERVO)
    tracker.process(standing(0.005))
    tracker.set_command(ALIENGO, ALIENGO.nominal_q + 0.1, MODE_DAMPING)
    tracker.process(standing(0.010))
    np.testing.assert_allclose(estimator.actions, np.array([np.zeros(12), np.full(12, 0.1), np.zeros(12)]))
