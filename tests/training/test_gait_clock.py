"""Stage 1: the gait clock, and the scripted trot that walks by it."""

from __future__ import annotations

from types import SimpleNamespace

import attrs
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_eval.gait_kind import GaitKind  # noqa: E402
from quadvel_training.env import CommandRange, EnvConfig, VelocityEnv  # noqa: E402
from quadvel_training.gait_clock import ACCELERATION, START_PHASE, GaitClock, duty_factor, step_frequency  # noqa: E402
from quadvel_training.past import Past  # noqa: E402
from quadvel_training.privileged import ACTION_SCALE, total_action  # noqa: E402
from quadvel_training.randomisation import Randomisation  # noqa: E402
from quadvel_training.scripted_trot import joint_offsets  # noqa: E402
from quadvel_training.similarity import Size  # noqa: E402
from tests.helpers.robots import ALIENGO, GO2  # noqa: E402

PERIOD = 0.02  # s
WALK, STAND = np.array([[1.0, 0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]])
NONE = np.zeros((1, 4), bool)


class FixedCommands:
    """One command for each robot, for ever."""

    hold = (1e3, 1e3)

    def __init__(self, command: np.ndarray) -> None:
        self.command = command

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return self.command[:n]

    def contains(self, velocity: np.ndarray) -> np.ndarray:
        return np.ones(len(velocity), bool)


def advance(clock: GaitClock, command: np.ndarray, speed: float = 0.0, stepped: np.ndarray = NONE) -> None:
    clock.advance(command, np.full(len(command), speed), stepped, PERIOD)


def test_steps_are_slow_at_rest_and_fast_and_short_on_the_ground_at_speed():
    velocity = np.array([[0.0, 0, 0], [0.5, 0, 0], [0, 0, 4.0], [-3.0, 0, 0], [4.2, 0, 0]])
    assert step_frequency(velocity) == pytest.approx([2.0, 2.475, 3.14, 4.4, 4.4])
    assert duty_factor(velocity) == pytest.approx([0.75, 0.7043, 0.64032, 0.4758, 0.36612])


def test_diagonal_feet_move_together_and_the_pairs_half_a_cycle_apart():
    clock = GaitClock(1)
    advance(clock, WALK)
    fr, fl, rr, rl = clock.foot_phases()[0]
    assert (fr, fl) == (rl, rr)
    assert abs(fr - fl) == pytest.approx(0.5)


def test_the_plan_accelerates_to_the_command_and_its_clock_runs_at_that_frequency():
    clock, phase = GaitClock(1), START_PHASE
    advance(clock, WALK)
    for cycle in range(2, 18):
        advance(clock, WALK)
        velocity = min(ACCELERATION[0] * PERIOD * cycle, 1.0)
        phase += PERIOD * (2.0 + 0.95 * velocity)
        assert clock.velocity[0] == pytest.approx([velocity, 0.0, 0.0])
    assert clock.phase[0] == pytest.approx(phase % 1.0)


def test_a_robot_that_is_told_to_stand_steps_until_it_is_at_rest_on_four_feet():
    clock = GaitClock(1)
    for _ in range(50):
        advance(clock, WALK, speed=1.0)
    for _ in range(50):
        advance(clock, STAND, speed=0.3)
    assert clock.walking[0]
    clock.phase[:] = 0.8  # FR and RL in the air
    advance(clock, STAND)
    assert clock.walking[0]
    clock.phase[:] = 0.6  # all four planned to be down
    advance(clock, STAND)
    assert not clock.walking[0]
    advance(clock, STAND)
    assert clock.phase[0] == START_PHASE


def test_a_standing_robot_that_is_pushed_steps():
    clock = GaitClock(2)
    clock.advance(np.repeat(STAND, 2, axis=0), np.array([0.1, 0.6]), np.zeros((2, 4), bool), PERIOD)
    assert clock.walking.tolist() == [False, True]


@pytest.mark.parametrize("late", [-0.1, 0.1])
def test_touchdowns_of_a_pair_correct_half_of_its_phase_error(late):
    clock = GaitClock(1)
    for _ in range(50):
        advance(clock, WALK)
    clock.phase[:] = late - step_frequency(clock.velocity) * PERIOD
    advance(clock, WALK, stepped=np.array([[True, False, False, True]]))
    assert clock.phase[0] == pytest.approx((0.5 * late) % 1.0)


def test_a_mirrored_robot_sees_its_clock_with_the_other_sign():
    clock = GaitClock(3)
    clock.phase[:], clock.walking[:] = [0.2, 0.7, 0.2], [True, True, False]
    one, other, standing = clock.observation()[:, :2]
    assert one == pytest.approx(-other)
    assert not standing.any()


def test_the_scripted_trot_alone_keeps_a_nominal_robot_on_its_feet():
    config = EnvConfig(
        robot=ALIENGO, n=1, threads=1, period=PERIOD, timestep=0.004, randomisation=Randomisation.none()
    )
    commands = CommandRange(vx=(0.5, 0.5), vy=0.0, wz=0.0, ellipsoid=False, stance=0.0)
    env = VelocityEnv(attrs.evolve(config, commands=commands, ramped=0.0))
    past, contact = Past(env), []
    for _ in range(150):
        command = env.command.copy()
        env.tick(env.stand_q + ACTION_SCALE * total_action(env, past, np.zeros((1, 12))))
        past.advance(command)
        contact.append(env.contact[0].copy())
        assert not env.fallen[0]
    kind = GaitKind.of(np.array(contact[50:]), np.zeros(100), PERIOD)
    assert kind.diagonal > 0.9
    assert kind.frequency == pytest.approx(2.475, rel=0.1)


COMMANDS = [
    (0.0, 0.0, 0.0),
    (0.8, 0.0, 0.0),
    (-0.5, 0.0, 0.0),
    (0.0, 0.3, 0.0),
    (0.0, 0.0, 0.6),
    (0.3, -0.3, 0.5),
]


@pytest.mark.parametrize("robot", [ALIENGO, GO2], ids=lambda robot: robot.name)
def test_the_scripted_trot_alone_stands_and_follows_slow_commands_in_all_directions(robot):
    n = len(COMMANDS)
    command = np.concatenate([COMMANDS, np.zeros((n, 1))], axis=1)
    command[0, 3] = 1.0  # stands
    config = EnvConfig(
        robot=robot, n=n, threads=1, period=PERIOD, timestep=0.004, randomisation=Randomisation.none()
    )
    env = VelocityEnv(attrs.evolve(config, ramped=0.0), FixedCommands(command))
    past, velocity = Past(env), []
    for _ in range(150):
        env.tick(env.stand_q + ACTION_SCALE * total_action(env, past, np.zeros((n, 12))))
        past.advance(command)
        velocity.append(np.concatenate([env.velocity[:, :2], env.angular_velocity[:, 2:]], axis=1))
        assert not env.fallen.any()
    error = np.mean(velocity[50:], axis=0) - COMMANDS
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.2
    assert np.abs(error[:, 2]).max() < 0.4


@pytest.mark.parametrize("robot", [ALIENGO, GO2], ids=lambda robot: robot.name)
def test_the_scripted_trot_alone_runs(robot):
    size = Size.of(robot)
    speeds = size.time * np.array([1.5, 2.0, 2.5])  # m/s
    command = np.zeros((3, 4))
    command[:, 0] = speeds
    config = EnvConfig(
        robot=robot, n=3, threads=1, period=PERIOD, timestep=0.004, randomisation=Randomisation.none()
    )
    env = VelocityEnv(attrs.evolve(config, ramped=0.0), FixedCommands(command))
    past, velocity, height = Past(env), [], []
    for _ in range(200):
        env.tick(env.stand_q + ACTION_SCALE * total_action(env, past, np.zeros((3, 12))))
        past.advance(command)
        velocity.append(env.velocity[:, 0].copy())
        height.append(env.height.copy())
        assert not env.fallen.any()
    assert (np.mean(velocity[100:], axis=0) > 0.75 * speeds).all()
    assert np.abs(np.mean(height[100:], axis=0) / size.length - 0.37).max() < 0.04


@pytest.mark.parametrize("vx", [0.5, 2.0, -1.5])
def test_the_targets_of_the_script_do_not_jump_over_a_cycle(vx):
    """The policy learns from them: a jump would be jitter of its joint targets."""
    n = 2000
    env = SimpleNamespace(
        robot=ALIENGO,
        size=Size(),
        roll_pitch=np.tile([0.05, -0.03], (n, 1)),
        angular_velocity=np.zeros((n, 3)),
        planar_velocity=np.tile([vx, 0.1, 0.3], (n, 1)),
        height=np.full(n, 0.39),
        ground_slope=np.zeros((n, 2)),
        ground_lean=np.zeros((n, 2)),
        stand_q=ALIENGO.nominal_q + np.tile([0.0, 0.05, 0.3], 4),  # targets that hold its weight
    )
    clock = GaitClock(n)
    clock.velocity[:], clock.walking[:] = [vx, 0.1, 0.3], True
    clock.phase = np.linspace(0.0, 1.0, n, endpoint=False)
    past = SimpleNamespace(clock=clock, steady=np.ones(n), lag=np.zeros((n, 3)), turn_correction=np.zeros(n))
    targets = joint_offsets(env, past)
    steps = np.abs(np.diff(targets, axis=0, append=targets[:1]))  # rad in 1/2000 of a cycle
    assert steps.max() < 0.02
