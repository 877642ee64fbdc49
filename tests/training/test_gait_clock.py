"""Stage 1: the gait clock, and the scripted trot that walks by it."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_eval.gait_kind import GaitKind  # noqa: E402
from quadvel_training.env import CommandRange, EnvConfig, VelocityEnv  # noqa: E402
from quadvel_training.gait_clock import START_PHASE, GaitClock, duty_factor, step_frequency  # noqa: E402
from quadvel_training.privileged import ACTION_SCALE, Past, total_action  # noqa: E402
from quadvel_training.randomisation import Randomisation  # noqa: E402
from tests.helpers.robots import ALIENGO  # noqa: E402

PERIOD = 0.02  # s
WALK, STAND = np.array([[1.0, 0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]])
NONE = np.zeros((1, 4), bool)


def test_steps_are_slow_at_rest_and_fast_and_short_on_the_ground_at_speed():
    command = np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0, 4.0, 0], [-3.0, 0, 0, 0], [4.2, 0, 0, 0]])
    assert step_frequency(command) == pytest.approx([1.9, 2.175, 2.56, 3.55, 4.2])
    assert duty_factor(command) == pytest.approx([0.68, 0.645, 0.596, 0.47, 0.386])


def test_diagonal_feet_move_together_and_the_pairs_half_a_cycle_apart():
    clock = GaitClock(1)
    clock.advance(WALK, NONE, PERIOD)
    fr, fl, rr, rl = clock.foot_phases()[0]
    assert (fr, fl) == (rl, rr)
    assert abs(fr - fl) == pytest.approx(0.5)


def test_the_clock_runs_at_its_frequency_and_waits_in_stance():
    clock = GaitClock(1)
    for _ in range(10):
        clock.advance(WALK, NONE, PERIOD)
    assert clock.phase[0] == pytest.approx((START_PHASE + 10 * PERIOD * 2.45) % 1.0)
    clock.advance(STAND, NONE, PERIOD)
    assert clock.phase[0] == START_PHASE


@pytest.mark.parametrize("late", [-0.1, 0.1])
def test_touchdowns_of_a_pair_correct_half_of_its_phase_error(late):
    clock = GaitClock(1)
    clock.phase[:] = late - step_frequency(WALK) * PERIOD
    clock.advance(WALK, np.array([[True, False, False, True]]), PERIOD)
    assert clock.phase[0] == pytest.approx((0.5 * late) % 1.0)


def test_a_mirrored_robot_sees_its_clock_with_the_other_sign():
    clock = GaitClock(2)
    clock.phase[:] = [0.2, 0.7]
    one, other = clock.observation(np.repeat(WALK, 2, axis=0))
    assert one == pytest.approx(-other)
    assert not clock.observation(np.repeat(STAND, 2, axis=0)).any()


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
    assert kind.frequency == pytest.approx(2.175, rel=0.1)
