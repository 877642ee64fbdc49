"""The trim removes a steady velocity error, within its bound, and only under a constant command."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_policy.observation import VelocityCommandLimits
from quadvel_policy.velocity_trim import VelocityTrim

LIMITS = VelocityCommandLimits((-2.0, -1.0, -4.0), (2.0, 1.0, 4.0))
TICK_S = 0.005


class SlowRobot:
    """Follows the command as a first-order lag with a constant error of velocity."""

    def __init__(self, error: tuple[float, float, float], bound: float = 0.1) -> None:
        self.trim = VelocityTrim(LIMITS, bound)
        self.error, self.velocity, self.got = np.array(error), np.zeros(3), np.zeros(4)

    def walk(self, command: tuple[float, ...], seconds: float) -> np.ndarray:
        """Return the velocity at each tick, (n, 3)."""
        path = []
        for _ in range(round(seconds / TICK_S)):
            self.got = self.trim.apply(np.array(command), self.velocity, float(self.velocity[2]))
            self.velocity = self.velocity + TICK_S / 0.3 * (self.got[:3] + self.error - self.velocity)
            path.append(self.velocity)
        return np.array(path)


def test_a_steady_error_of_each_axis_goes_to_zero_without_oscillation() -> None:
    robot = SlowRobot((-0.06, 0.03, -0.05))
    path = robot.walk((1.0, 0.2, 0.5, 0.0), 12.0)
    np.testing.assert_allclose(path[-1], (1.0, 0.2, 0.5), atol=0.001)
    assert (path[:, 0] < 1.02).all()


def test_a_robot_without_an_error_is_hardly_trimmed() -> None:
    robot = SlowRobot((0.0, 0.0, 0.0))
    path = robot.walk((1.0, 0.0, 0.0, 0.0), 8.0)
    assert np.abs(path[:, 0]).max() < 1.025


@pytest.mark.parametrize("bound", [0.0, 0.05, 0.1])
def test_the_trim_stays_within_its_bound(bound: float) -> None:
    robot = SlowRobot((-0.5, 0.5, -0.5), bound)
    robot.walk((1.0, 0.0, 0.5, 0.0), 15.0)
    np.testing.assert_allclose(robot.got, (1.0 + bound, -bound, 0.5 + bound, 0.0), atol=1e-9)


def test_a_trimmed_command_stays_within_the_limits_of_the_policy() -> None:
    robot = SlowRobot((-0.05, 0.0, 0.0))
    robot.walk((2.0, 0.0, 0.0, 0.0), 10.0)
    assert robot.got[0] == 2.0
    assert robot.trim.trim[0] == 0.0, "what the policy does not get is not stored, either"
    robot.walk((1.9, 0.0, 0.0, 0.0), TICK_S)
    assert robot.got[0] == 1.9


@pytest.mark.parametrize(
    "command", [(2.5, 0.0, 0.225), (-2.1, 0.0, 0.291), (0.39, 0.22, -4.05), (1.8, 0.6, 0.5)]
)
@pytest.mark.parametrize("error", [(-0.03, 0.0, 0.0), (-0.15, 0.15, -0.15), (0.15, -0.15, 0.15)])
def test_more_speed_takes_no_more_turn_rate_than_the_bound(
    command: tuple[float, float, float], error: tuple[float, float, float]
) -> None:
    """The limits of the policy couple the axes: a trim of vx must not remove a commanded turn."""
    limits = VelocityCommandLimits((-2.2, -1.5, -5.0), (2.6, 1.5, 5.0), 5.0)
    wanted = limits.clamp(command)
    trim = VelocityTrim(limits, 0.1)
    for _ in range(round(20.0 / TICK_S)):
        velocity = np.array(wanted) + error
        got = trim.apply(np.array([*wanted, 0.0]), velocity, velocity[2])
        assert np.abs(got[:3] - wanted).max() <= 0.1 + 1e-6
        np.testing.assert_allclose(limits.clamp(got[:3].tolist()), got[:3], atol=1e-9)


def test_the_trim_fades_while_the_command_changes_and_ends_in_stance() -> None:
    robot = SlowRobot((-0.06, 0.0, 0.0))
    robot.walk((1.0, 0.0, 0.0, 0.0), 10.0)
    before = robot.got[0] - 1.0
    robot.walk((-1.0, 0.0, 0.0, 0.0), 1.0)
    assert 0.0 < robot.got[0] + 1.0 < 0.5 * before
    robot.walk((0.0, 0.0, 0.0, 1.0), 2 * TICK_S)
    np.testing.assert_array_equal(robot.got, (0.0, 0.0, 0.0, 1.0))
    robot.walk((1.0, 0.0, 0.0, 0.0), TICK_S)
    np.testing.assert_array_equal(robot.got, (1.0, 0.0, 0.0, 0.0))


def test_a_robot_that_brakes_to_a_stand_is_not_trimmed() -> None:
    robot = SlowRobot((0.0, 0.0, 0.0))
    robot.velocity = np.array([0.3, -0.3, 0.2])
    robot.walk((0.0, 0.0, 0.0, 0.0), 0.5)
    np.testing.assert_array_equal(robot.got, np.zeros(4))


def test_a_noisy_command_counts_as_constant() -> None:
    robot, rng = SlowRobot((-0.06, 0.0, 0.0)), np.random.default_rng(0)
    for vx in rng.uniform(0.98, 1.02, 400):
        robot.walk((vx, 0.0, 0.0, 0.0), 5 * TICK_S)
    assert robot.velocity[0] == pytest.approx(1.0, abs=0.02)


def test_a_reset_forgets_the_trim() -> None:
    robot = SlowRobot((-0.06, 0.0, 0.0))
    robot.walk((1.0, 0.0, 0.0, 0.0), 10.0)
    robot.trim.reset()
    robot.walk((1.0, 0.0, 0.0, 0.0), TICK_S)
    assert robot.got[0] == 1.0
