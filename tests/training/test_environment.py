"""The training environment, its rewards, and resumption of runs."""

from __future__ import annotations

import signal

import attrs
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_description.kinematics import rotate  # noqa: E402
from quadvel_description.quadruped import GRAVITY  # noqa: E402
from quadvel_policy.command_mux import CommandMux, MuxConfig, MuxInput  # noqa: E402
from quadvel_sim.terrain import Terrain  # noqa: E402
from quadvel_training import loop, recipe, stages  # noqa: E402
from quadvel_training.constrained import PARTS, ConstrainedConfig, ConstrainedRun  # noqa: E402
from quadvel_training.env import RAMP_AXES, RAMP_DOWN, TICK_S, CommandRange, EnvConfig, VelocityEnv  # noqa: E402
from quadvel_training.privileged import PrivilegedConfig  # noqa: E402
from quadvel_training.randomisation import Randomisation  # noqa: E402
from quadvel_training.rewards import RewardWeights, Table2  # noqa: E402
from tests.helpers.robots import ALIENGO  # noqa: E402

STANDING = CommandRange(stance=1.0, hold=(100.0, 100.0))
QUIET = EnvConfig(
    robot=ALIENGO, n=4, threads=1, seed=3, randomisation=Randomisation.none(), commands=STANDING
)


def stand(env):
    """A tick in which stiff joints hold the standing posture."""
    gains = np.ones((env.config.n, 12))
    env.tick(np.tile(ALIENGO.nominal_q, (env.config.n, 1)), kp=150.0 * gains, kd=5.0 * gains)


def test_targets_beyond_the_range_push_as_the_whole_target_would():
    env = VelocityEnv(QUIET)
    target = env.stand_q + np.tile([0.0, 0.0, 1.0], 4)
    env.tick(np.tile(env.stand_q, (4, 1)))
    for _ in range(3):
        before = env.q
        env.tick(np.tile(target, (4, 1)))
    knees = slice(2, None, 3)
    asked = ALIENGO.kp * (target - before)[:, knees]
    within = ALIENGO.kp * (ALIENGO.command_upper - before)[:, knees]
    assert (env.torque[:, knees] > 0.8 * asked).all()  # damped, and delayed by some ms
    assert (env.torque[:, knees] > 1.1 * within).all()


def test_equal_seeds_give_equal_runs_and_other_seeds_do_not():
    def run(seed):
        env = VelocityEnv(attrs.evolve(QUIET, seed=seed, randomisation=Randomisation()))
        for _ in range(20):
            env.tick(np.tile(env.stand_q, (4, 1)))
            env.sense()
        return env.q

    assert np.array_equal(run(5), run(5))
    assert not np.array_equal(run(5), run(6))


def test_commands_of_the_ellipsoid_lie_in_it():
    commands = CommandRange(vx=(-4.5, 4.5), vy=2.0, wz=4.0, ellipsoid=True, stance=0.2, straight=0.0)
    drawn = commands.draw(np.random.default_rng(0), 5000)
    assert np.sum((drawn[:, :3] / [4.5, 2.0, 4.0]) ** 2, axis=1).max() <= 1.0
    assert np.mean(drawn[:, 3]) == pytest.approx(0.2, abs=4 * np.sqrt(0.2 * 0.8 / 5000))
    assert (drawn[drawn[:, 3] == 1, :3] == 0).all()


def test_led_commands_go_the_way_that_the_command_mux_leads_them():
    env, grow, time = VelocityEnv(QUIET), 2.0 * RAMP_AXES, 0.0
    config = MuxConfig(
        acceleration=tuple(grow), stop_acceleration=tuple(RAMP_DOWN * grow), dead_zone=(1e-9,) * 3
    )
    mux = CommandMux([MuxInput("planner", priority=0, timeout=9.0)], config)
    mux.update(time)
    env._ramp[:] = 2.0
    for goal in (
        [1.5, -0.4, 2.0, 0.0],
        [0.2, 0.133, 0.0, 0.0],
        [-0.3, 0.133, 0.4, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ):
        env._goal[:] = goal
        for _ in range(round(1.0 / TICK_S)):
            stand(env)
            time += TICK_S
            mux.receive("planner", time, goal[:3])
            wanted = mux.update(time)
            np.testing.assert_allclose(env.command[2], [*wanted.velocity, wanted.stance], atol=1e-9)
        assert env.command[2].tolist() == goal


def test_a_robot_that_has_to_stand_steps_until_it_is_slow_as_under_the_supervisor():
    env = VelocityEnv(attrs.evolve(QUIET, n=8, ramped=0.0))
    env._goal[:], env._ramp[:] = [0.0, 0.0, 0.0, 1.0], np.inf
    env.velocity[:4], env.velocity[4:] = [0.15, 0.0, 0.0], [0.25, 0.0, 0.0]
    env._ramp_commands(slice(None))
    assert env.command[:, 3].tolist() == [1.0] * 4 + [0.0] * 4
    assert not env.command[:, :3].any()


def test_a_share_of_the_commands_is_led_and_the_others_come_at_once():
    env = VelocityEnv(attrs.evolve(QUIET, n=400, ramped=0.3, commands=CommandRange(stance=0.0)))
    assert np.mean((env.command == env._goal).all(axis=1)) == pytest.approx(0.7, abs=0.1)
    assert (env.command[:, 3] == 0.0).all()


def test_acceleration_at_rest_is_gravity_upwards():
    env = VelocityEnv(QUIET)
    seen = []
    for _ in range(400):
        stand(env)
        seen.append(env.acceleration)
    assert np.mean(seen[200:], axis=(0, 1)) == pytest.approx([0.0, 0.0, GRAVITY], abs=0.15)


def test_velocity_is_the_derivative_of_position_in_the_body_frame():
    env = VelocityEnv(attrs.evolve(QUIET, timestep=0.001))
    for _ in range(10):
        env.tick(np.tile(env.stand_q, (4, 1)))
    before = env.batch.qpos[:, :3].copy()
    slow = env.velocity.copy()
    env.tick(np.tile(env.stand_q, (4, 1)))
    mean = 0.5 * (slow + env.velocity)
    moved = (env.batch.qpos[:, :3] - before) / TICK_S
    assert np.abs(rotate(env.quaternion, mean) - moved).max() < 0.05


def test_rewards_of_table_2_at_a_state_computed_by_hand():
    env = VelocityEnv(QUIET)
    table = Table2(env, RewardWeights())
    env.command[:] = [[0.5, -0.3, 0.2, 0.0]] * 4
    env.velocity = np.tile([0.2, -0.4, 0.1], (4, 1))
    env.angular_velocity = np.tile([0.3, 0.4, 0.1], (4, 1))
    env.roll_pitch = np.tile([0.1, -0.2], (4, 1))
    env.torque, env.dq = np.full((4, 12), 2.0), np.full((4, 12), -0.1)
    env.contact = np.ones((4, 4), bool)
    env.foot_velocity = np.tile([0.1, 0.0, 0.5], (4, 4, 1))
    table._dq = np.full((4, 12), -0.2)
    table._air_time[:, 0] = 0.3
    terms = {name: value[0] for name, value in table.terms(np.full((4, 12), 0.1)).items()}
    assert terms["linear_tracking"] == pytest.approx(np.exp(-(0.09 + 0.01)))
    assert terms["angular_tracking"] == pytest.approx(np.exp(-0.01))
    assert terms["orientation"] == pytest.approx(-0.3)
    assert terms["torso_stability"] == pytest.approx(-0.5 - 0.1)
    assert terms["joint_velocity"] == pytest.approx(-0.12)
    assert terms["joint_acceleration"] == pytest.approx(-12 * (0.1 / TICK_S) ** 2)
    assert terms["slippage"] == pytest.approx(-0.04)
    assert terms["energy"] == pytest.approx(-12 * (0.2 * 4.0 - 0.2))
    assert terms["velocity_compensation"] == pytest.approx(np.hypot(0.2, 0.3))
    assert terms["foot_lift_time"] == pytest.approx((0.3 - 0.2) * (1 - 0.34))
    assert terms["foot_clearance"] == 0.0
    assert terms["action_smoothness"] == pytest.approx(-1.2)


def test_lifting_feet_pays_only_while_walking_and_posture_counts_only_in_stance():
    env = VelocityEnv(QUIET)
    table = Table2(env, RewardWeights())
    env.contact = np.zeros((4, 4), bool)
    env.clearance = np.full((4, 4), 0.03)
    env.command[:] = [0.0, 0.0, 0.0, 1.0]
    env.q = ALIENGO.nominal_q + np.linspace(-0.1, 0.2, 12) * np.ones((4, 1))
    assert table.terms(np.zeros((4, 12)))["posture"][0] == pytest.approx(
        -np.abs(np.linspace(-0.1, 0.2, 12)).sum()
    )
    assert table.terms(np.zeros((4, 12)))["foot_clearance"][0] == 0.0
    env.command[:] = 0.0
    assert table.terms(np.zeros((4, 12)))["posture"][0] == 0.0
    assert table.terms(np.zeros((4, 12)))["foot_clearance"][0] == pytest.approx(0.12)


def test_joints_nearly_as_fast_as_their_drives_are_fined():
    env = VelocityEnv(EnvConfig(robot=ALIENGO, n=2, threads=1, randomisation=Randomisation.none()))
    env.dq = np.zeros((2, 12))
    env.dq[0, :6] = 0.89 * ALIENGO.velocity_limit[:6]
    env.dq[1, 1], env.dq[1, 5] = 19.0, -15.301  # of 20 and 15.89 rad/s
    fine = Table2(env, RewardWeights()).terms(np.zeros((2, 12)))["overspeed"]
    assert fine == pytest.approx([0.0, -2.0])


class Counter:
    """A run that counts its steps."""

    def __init__(self) -> None:
        self.samples = 0

    def step(self, done):
        self.samples += 10
        return {"count": float(self.samples)}

    def state(self):
        return {"samples": self.samples}

    def restore(self, state):
        self.samples = state["samples"]


def test_a_run_resumes_where_its_checkpoint_stands(tmp_path):
    path = tmp_path / "run.pt"
    loop.train(Counter(), loop.Budget(samples=50, minutes=1.0), path)
    again = Counter()
    loop.train(again, loop.Budget(samples=80, minutes=1.0), path)
    assert again.samples == 80
    kept = loop.load(path)
    assert kept["samples"] == 80
    assert kept["seconds"] > 0.0


def test_ctrl_c_ends_a_run_after_the_update_under_way(tmp_path, capsys):
    class Interrupted(Counter):
        def step(self, done):
            signal.raise_signal(signal.SIGINT)
            return super().step(done)

    assert not loop.train(Interrupted(), loop.Budget(samples=50, minutes=1.0), tmp_path / "run.pt")
    assert loop.load(tmp_path / "run.pt")["samples"] == 10
    assert "stopped" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_resumed_run_of_stage_3_draws_on_where_it_was_saved(tmp_path):
    config = ConstrainedConfig(n=3, length=3, threads=1, critic_first=0)
    first = ConstrainedRun(config)
    seen = first.step(0.0)
    assert sum(seen[part] for part in PARTS) == pytest.approx(1.0)
    loop.save(first.state(), tmp_path / "constrained.pt")
    first._start_over(np.arange(3))
    expected = first.env.rng.random(), torch.rand(1)
    second = ConstrainedRun(config)
    second.restore(loop.load(tmp_path / "constrained.pt"))
    assert (second.env.rng.random(), torch.rand(1)) == expected
    assert second.samples == 9


def test_a_missing_checkpoint_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere[.]pt: no such checkpoint"):
        loop.load(tmp_path / "nowhere.pt")


@pytest.mark.parametrize("degrees", [0.0, 20.0, -20.0])
def test_robots_start_with_four_feet_on_a_slope_whichever_way_they_look(degrees):
    slope = Terrain(kind="slope", slope=float(np.radians(degrees))) if degrees else Terrain()
    config = EnvConfig(robot=ALIENGO, n=16, threads=1, terrain=slope, randomisation=Randomisation.none())
    env = VelocityEnv(config)
    env._qpos[:, 7:] = ALIENGO.nominal_q
    env._update_state()
    across = env.clearance * np.cos(np.radians(degrees))  # m, from the ground, at right angles to it
    assert np.ptp(across, axis=1).max() < 0.002
    assert np.hypot(*env.roll_pitch.T) == pytest.approx(np.radians(abs(degrees)), abs=0.03)


def test_the_field_of_hills_slopes_by_up_to_20_degrees():
    ground = recipe.read_recipe(PrivilegedConfig, stages.RECIPES / "privileged_rough.yaml").terrain
    ground = attrs.evolve(ground, roughness=0.001)
    x, y = np.random.default_rng(0).uniform(-24.0, 24.0, (2, 20000))
    steep = [
        ground.height(x + dx, y + dy) - ground.height(x - dx, y - dy) for dx, dy in ((0.25, 0.0), (0.0, 0.25))
    ]
    assert np.degrees(np.arctan(np.hypot(*steep) / 0.5)).max() == pytest.approx(20.0, abs=2.0)
