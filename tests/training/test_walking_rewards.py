"""Stage 1: rewards of a trot, each against its formula, and the log of the gait."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_description.quadruped import joint_index  # noqa: E402
from quadvel_eval.gait_kind import GaitKind  # noqa: E402
from quadvel_training import loop, teacher_walks  # noqa: E402
from quadvel_training.__main__ import app  # noqa: E402
from quadvel_training.command_grid import CommandGrid, GridConfig  # noqa: E402
from quadvel_training.env import CommandRange, EnvConfig, VelocityEnv  # noqa: E402
from quadvel_training.gait_clock import duty_factor  # noqa: E402
from quadvel_training.past import Past  # noqa: E402
from quadvel_training.privileged import PrivilegedConfig, PrivilegedRun  # noqa: E402
from quadvel_training.randomisation import RATED_SPEED, RATED_STALL, Randomisation, rated_drives  # noqa: E402
from quadvel_training.walking_rewards import (  # noqa: E402
    OVERSPEED_SHARE,
    SWING_CLEARANCE_M,
    WalkingRewards,
    WalkingWeights,
)
from tests.helpers.robots import ALIENGO  # noqa: E402

N = 3
CALM = EnvConfig(
    robot=ALIENGO, n=N, threads=1, period=0.02, timestep=0.004, randomisation=Randomisation.none()
)


@pytest.fixture
def env():
    return VelocityEnv(CALM)


@pytest.fixture
def past(env):
    return Past(env)


def terms(env, past, command=(0.5, 0.0, 0.0, 0.0)):
    rewards = WalkingRewards(env, WalkingWeights())
    return rewards.terms(np.tile(command, (N, 1)).astype(float), past, np.zeros((3, N, 12)))


def test_feet_are_paid_for_being_down_and_up_as_the_clock_plans(env, past):
    past.clock.phase[:], past.clock.walking[:] = 0.9, True  # FR and RL swing, FL and RR stand
    env.contact[:] = [(False, True, True, False), (True,) * 4, (True, False, False, True)]
    weight = WalkingWeights().schedule
    assert terms(env, past)["schedule"] == pytest.approx([weight, 0.5 * weight, 0.0])
    past.clock.walking[:] = False
    assert not terms(env, past, command=(0.0, 0.0, 0.0, 1.0))["schedule"].any()


def test_clearance_is_paid_in_the_planned_swing_up_to_a_half_sine(env, past):
    past.clock.velocity[:], past.clock.walking[:] = [0.5, 0.0, 0.0], True
    duty = duty_factor(past.clock.velocity)[0]
    past.clock.phase[:] = 0.5 * (1.0 + duty)  # FR and RL in the middle of their swing
    env.clearance[:] = [[SWING_CLEARANCE_M] * 4, [0.5 * SWING_CLEARANCE_M] * 4, [9.0] * 4]
    weight = WalkingWeights().lift
    assert terms(env, past)["lift"] == pytest.approx([0.5 * weight, 0.25 * weight, 0.5 * weight])
    past.clock.phase[:] = duty  # they lift off: no clearance is wanted yet
    assert terms(env, past)["lift"] == pytest.approx(np.zeros(N), abs=1e-9)


def test_stance_is_fined_at_lift_off_by_how_far_its_middle_is_from_the_hip(env, past):
    ahead = 0.2 * np.array([[1, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]])
    left = np.array([-0.2, -0.3, -0.1])
    env.contact[:] = True
    env.contact[:, 0] = False
    past.advance(np.zeros((N, 4)))
    env.foot_position[..., 0] = ALIENGO.legs.hips[:, 0] + ahead
    env.contact[:, 0] = True
    past.advance(np.zeros((N, 4)))
    assert not past.off_hip.any()
    env.foot_position[:, 0, 0] = ALIENGO.legs.hips[:, 0][0] + left
    past.advance(np.zeros((N, 4)))
    env.foot_position[:, 0, 0] = 9.9  # in the air it counts no more
    env.contact[:, 0] = False
    past.advance(np.zeros((N, 4)))
    assert past.off_hip[:, 0] == pytest.approx([0.0, -0.05, 0.05])
    assert not past.off_hip[:, 1:].any()
    weight = WalkingWeights().off_hip
    assert terms(env, past)["off_hip"] == pytest.approx([0.0, -0.05 * weight, -0.05 * weight])
    past.advance(np.zeros((N, 4)))
    assert not past.off_hip.any()


def test_sway_is_the_sideways_velocity_off_its_mean_over_a_stride(env, past):
    past.clock.walking[:] = True
    env.velocity[:, 1] = [0.1, 0.1, 2.0]
    past.stride[:, 1] = [-0.1, 0.0, 0.0]  # the mean over a stride is minus that, as the command is 0
    weight = WalkingWeights().sway
    assert terms(env, past)["sway"] == pytest.approx([0.0, -weight * 0.01, -weight * 0.1])


def test_roll_rate_and_joints_beyond_eight_tenths_of_their_drives_speed_are_fined(env, past):
    past.clock.walking[:] = True
    env.angular_velocity[:, 0] = [0.0, 2.0, 100.0]
    env.fastest[:] = 0.0
    env.fastest[1] = OVERSPEED_SHARE * ALIENGO.velocity_limit
    env.fastest[1, 2] += 1.5
    env.fastest[2, 0] = 1e3
    w = WalkingWeights()
    assert terms(env, past)["roll"] == pytest.approx([0.0, -4 * w.roll, -10 * w.roll])
    assert terms(env, past)["overspeed"] == pytest.approx([0.0, -1.5 * w.overspeed, -8 * w.overspeed])


def test_power_weighs_five_times_as_much_at_rest_and_as_ever_from_1_m_s_on(env, past):
    env.power[:] = 100.0
    for speed, factor in ((0.0, 5.0), (0.5, 4.0 / 1.25), (1.0, 1.0 / 1.5), (2.0, 1.0 / 2.0)):
        weight = WalkingWeights().power
        assert terms(env, past, (speed, 0, 0, 0))["power"] == pytest.approx(
            [-100.0 * weight * factor] * N, rel=1e-3
        )


def test_the_fastest_speed_of_a_sample_is_that_of_all_its_steps(env):
    env._qvel[1, 8] = 12.0
    env.tick(np.tile(env.stand_q, (N, 1)))
    assert env.fastest[1, 2] > abs(env.dq[1, 2]) + 1.0
    assert (env.fastest >= np.abs(env.dq) - 1e-9).all()


@pytest.mark.parametrize("commands", [None, CommandGrid(GridConfig())])
def test_commands_reverse_where_the_contrary_may_be_drawn(commands):
    env = VelocityEnv(
        attrs.evolve(CALM, n=200, reversed=1.0, commands=CommandRange(vx=(-0.5, 2.0), stance=0.0)), commands
    )
    before = env._goal.copy()
    env._new_commands(np.arange(200))
    allowed = env.commands.contains(-before[:, :3]) & before[:, :3].any(axis=1)
    assert allowed.sum() > 20
    assert np.array_equal(env._goal[allowed, :3], -before[allowed, :3])
    assert not env._goal[allowed, 3].any()
    other = env._goal[~allowed, :3]
    assert not (other == -before[~allowed, :3]).all(axis=1)[before[~allowed, :3].any(axis=1)].any()


def test_a_rated_drive_gives_full_torque_at_rest_and_none_at_its_top_speed():
    stall, no_load = (
        np.concatenate(
            [[effect.intervals[name]] * len(effect.joints) for effect in rated_drives(ALIENGO).effects]
        )
        for name in ("stall", "no_load")
    )
    names = [joint for effect in rated_drives(ALIENGO).effects for joint in effect.joints]
    order = joint_index(names)
    assert sorted(order) == list(range(12))
    assert stall == pytest.approx(np.outer(ALIENGO.torque_limit[order], RATED_STALL))
    assert no_load == pytest.approx(np.outer(ALIENGO.velocity_limit[order], RATED_SPEED))


def test_the_kind_of_gait_is_logged_at_each_speed_with_each_numbered_checkpoint(tmp_path, capsys):
    run = PrivilegedRun(PrivilegedConfig(n=6, threads=1, length=4, keep=1000.0))
    figures = teacher_walks.WalkLog(run, tmp_path).keep()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == [
        f"walk at {vx:g}, 0 m/s, 0 rad/s" for vx, _, _ in teacher_walks.LOGGED_COMMANDS
    ]
    fell = ["1 of 1 fell" in line for line in lines]
    assert len(figures) == (len(attrs.fields(GaitKind)) + 1) * fell.count(False)
    assert (tmp_path / "kept" / "000000k.pt").is_file()


def test_a_teacher_walks_at_every_command_of_the_table(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(teacher_walks, "WALK_S", 0.2)
    monkeypatch.setattr(teacher_walks, "MEASURED_S", 0.1)
    loop.save(PrivilegedRun(PrivilegedConfig(n=6, threads=1, length=4)).state(), tmp_path / "privileged.pt")
    app(["walks", "--teacher", str(tmp_path / "privileged.pt"), "--robots", "2"], standalone_mode=False)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(teacher_walks.TABLE_COMMANDS)
    assert all("0 of 2 fell" in line for line in lines)
