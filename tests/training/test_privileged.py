"""Stage 1: the command grid, and a run that survives diverged physics and being killed."""

from __future__ import annotations

import math

import attrs
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_description import symmetry  # noqa: E402
from quadvel_description.kinematics import foot_positions  # noqa: E402
from quadvel_policy.observation import VelocityCommandLimits  # noqa: E402
from quadvel_sim.terrain import Terrain  # noqa: E402
from quadvel_training import loop, privileged, process_group, scripted_trot  # noqa: E402
from quadvel_training.command_grid import CELL_WIDTH, INITIAL_REACH, CommandGrid, GridConfig  # noqa: E402
from quadvel_training.env import EnvConfig, VelocityEnv  # noqa: E402
from quadvel_training.past import (  # noqa: E402
    CATCH_UP_TURN,
    LASTING_S,
    MAX_LAG,
    STANDING_S,
    STEADY_END_S,
    STEADY_S,
    TRANSIENT_S,
    Past,
)
from quadvel_training.privileged import (  # noqa: E402
    CommandScorer,
    NumberedCheckpoints,
    PrivilegedConfig,
    PrivilegedRun,
)
from quadvel_training.randomisation import Randomisation  # noqa: E402
from quadvel_training.scripted_trot import joint_offsets  # noqa: E402
from quadvel_training.walking_rewards import (  # noqa: E402
    MAX_REWARD,
    MIN_REWARD,
    WalkingRewards,
    WalkingWeights,
    hip_deviation,
)
from tests.helpers.robots import ALIENGO  # noqa: E402

SMALL = PrivilegedConfig(n=6, threads=1, length=4)
CALM = EnvConfig(
    robot=ALIENGO, n=4, threads=1, period=0.02, timestep=0.004, randomisation=Randomisation.none()
)


@pytest.fixture
def grid():
    return CommandGrid(GridConfig())


def follow(grid, command, times, error=(0.0, 0.0), fell=False):
    for _ in range(times):
        grid.record(np.array([[*command, 0.0]]), np.array([error]), np.array([fell]))


def test_commands_begin_near_rest_and_lie_within_the_limits(grid):
    drawn = grid.draw(np.random.default_rng(0), 2000)
    assert (np.abs(drawn[:, :3]) <= np.array(INITIAL_REACH) + 0.5 * np.array(CELL_WIDTH)).all()
    grid.open[:] = grid.allowed
    limits = grid.config.limits()
    drawn = grid.draw(np.random.default_rng(0), 2000)
    assert np.allclose([limits.clamp(one) for one in drawn[:, :3].tolist()], drawn[:, :3])
    assert drawn[:, 0].max() > 3.9
    assert drawn[:, 2].max() > 5.5
    assert (drawn[drawn[:, 3] == 1, :3] == 0).all()


def test_slow_commands_stay_frequent_however_large_the_grid(grid):
    grid.open[:] = grid.allowed
    drawn = grid.draw(np.random.default_rng(0), 4000)
    slow = (np.abs(drawn[:, :3]) <= np.array(INITIAL_REACH) + 0.5 * np.array(CELL_WIDTH)).all(axis=1) & (
        drawn[:, 3] == 0
    )
    assert np.mean(slow) > 0.2
    assert 0.2 < np.mean(drawn[slow, 2] == 0.0) < 0.8


def test_running_commands_turn_too(grid):
    grid.open[:] = grid.allowed
    drawn = grid.draw(np.random.default_rng(0), 4000)
    running = drawn[np.abs(drawn[:, 0]) > 2.0]
    assert np.mean(np.abs(running[:, 2]) > 0.3) > 0.15


def test_commands_along_an_axis_are_often_faster_than_what_is_followed():
    grid = CommandGrid(GridConfig(axis=1.0, straight=0.0, near=0.0, stance=0.0, frontier=0.5))
    for ahead in (-1.0, -0.5, 0.0, 0.5, 1.0):
        follow(grid, (ahead, 0.0, 0.0), 8)
    drawn = grid.draw(np.random.default_rng(0), 4000)
    ahead = drawn[(drawn[:, 0] != 0.0), 0]
    assert 0.5 < np.mean(np.abs(ahead) > 1.25) < 0.75
    assert np.abs(drawn[:, 0]).max() <= 1.75


def test_neighbours_open_where_both_xy_and_yaw_are_followed(grid):
    edge, beyond = (1.0, 0.0, 0.0), (1.5, 0.0, 0.0)
    assert grid.open[grid.cell_of(np.array(edge))]
    follow(grid, edge, 8, error=(0.0, 0.5))
    follow(grid, edge, 8, error=(0.5, 0.0))
    follow(grid, edge, 8, fell=True)
    assert not grid.open[grid.cell_of(np.array(beyond))]
    follow(grid, edge, 4)
    assert grid.open[grid.cell_of(np.array(beyond))]
    assert not grid.open[grid.cell_of(np.array((2.5, 0.0, 0.0)))]


def test_cells_close_again_where_commands_are_followed_no_more(grid):
    for ahead in (1.0, 1.5, 2.0):
        follow(grid, (ahead, 0.0, 0.0), 4)
    assert grid.open[grid.cell_of(np.array((2.5, 0.0, 0.0)))]
    assert grid.summary()["forward"] == 2.0
    follow(grid, (2.0, 0.0, 0.0), 5, fell=True)
    assert not grid.open[grid.cell_of(np.array((2.5, 0.0, 0.0)))]
    assert grid.open[grid.cell_of(np.array((2.0, 0.0, 0.0)))]
    assert grid.summary()["forward"] == 1.5


def test_a_grid_draws_commands_within_what_is_taught_alone():
    taught = VelocityCommandLimits((-1.2, -0.5, -1.0), (1.4, 0.5, 1.0), curve=1.5)
    whole, grid = (CommandGrid(GridConfig(stance=0.0, taught=one)) for one in (None, taught))
    assert whole.shape == grid.shape
    for one in (whole, grid):
        one.success[:] = 1.0
        one.record(np.zeros((0, 4)), np.zeros((0, 2)), np.zeros(0, bool))
    assert whole.draw(np.random.default_rng(1), 2000)[:, 0].max() > 3.0
    drawn = grid.draw(np.random.default_rng(1), 2000)[:, :3]
    assert [taught.clamp(one) for one in drawn.tolist()] == [pytest.approx(one) for one in drawn.tolist()]
    assert np.ptp(drawn, axis=0) == pytest.approx([2.6, 1.0, 2.0], rel=0.05)
    assert not grid.contains(np.array([[2.0, 0.0, 0.0]]))[0]


def test_what_is_followed_to_the_left_is_open_to_the_right(grid):
    left, right = (np.array((0.5, 0.8 * side, 0.7 * side)) for side in (1, -1))
    assert not grid.open[grid.cell_of(left)]
    follow(grid, (0.5, 0.4, 0.7), 4)
    assert grid.open[grid.cell_of(left)]
    assert grid.open[grid.cell_of(right)]


def test_the_teachers_mirror_undoes_itself():
    x = np.random.default_rng(0).normal(size=(3, privileged.OBSERVATION_SIZE))
    assert np.array_equal(privileged.MIRROR(privileged.MIRROR(x)), x)


def test_the_mirrored_robot_observes_the_mirror_image():
    env = VelocityEnv(attrs.evolve(CALM, n=2))
    env.command[:] = [[0.7, 0.2, -0.4, 0.0], [0.7, -0.2, 0.4, 0.0]]
    past = Past(env)
    joints = np.random.default_rng(0).normal(0, 0.1, 12)
    for ids, mirror in ((0, lambda x: x), (1, symmetry.JOINTS)):
        env._qpos[ids, 3:7] = [1.0, 0.0, 0.0, 0.0]
        env._qpos[ids, 2] = 0.4
        env._qpos[ids, 7:] = mirror(joints) + ALIENGO.nominal_q
        env._qvel[ids, 6:] = mirror(3 * joints)
        env._qvel[ids, :6] = [0.5, (0.1, -0.1)[ids], 0.0, (0.2, -0.2)[ids], 0.3, (0.4, -0.4)[ids]]
    env._update_state()
    past.advance(env.command)
    past.clock.phase[:] = [0.2, 0.7]  # mirrored steps come half a cycle later
    past.lag[:], past.clock.walking[:] = [[0.1, 0.05, 0.2], [0.1, -0.05, -0.2]], True
    trot = joint_offsets(env, past)
    assert trot[1] == pytest.approx(symmetry.JOINTS(trot[0]), abs=1e-4)
    one, other = privileged.observe(env, past, np.stack([joints, symmetry.JOINTS(joints)]))
    assert np.allclose(privileged.MIRROR(one), other, atol=1e-5)


def walking_feet(env: VelocityEnv, planned: list[float], lag: list[float]) -> np.ndarray:
    """Feet (4, 3) of the scripted trot of a robot that moves as planned."""
    past = Past(env)
    past.clock.walking[:], past.lag[:, : len(lag)] = True, lag
    past.clock.velocity[:], past.steady[:] = planned, 1.0
    env.velocity[:, :2], env.angular_velocity[:] = planned[:2], [0.0, 0.0, planned[2]]
    offsets = joint_offsets(env, past)
    return foot_positions(ALIENGO, ALIENGO.nominal_q + offsets[0])


@pytest.fixture
def weightless(monkeypatch):
    monkeypatch.setattr(scripted_trot, "LOAD", 0.0)  # no torque fed forward: joints have the feet's targets


def test_a_robot_that_lags_behind_places_its_feet_behind_and_one_that_drifts_aside(weightless):
    env = VelocityEnv(CALM)
    usual = walking_feet(env, [1.0, 0.0, 0.0], [0.0, 0.0])
    moved = walking_feet(env, [1.0, 0.0, 0.0], [0.2, -0.2]) - usual
    placed = 0.2 * scripted_trot.CATCH_UP
    assert moved[:, :2] == pytest.approx(np.tile([-placed, placed], (4, 1)), abs=2e-3)


def feet_on_slope(rise: float) -> np.ndarray:
    """Feet (4, 3) of the scripted trot, up a slope (rad), with the trunk parallel to it and at its height."""
    kind = "slope" if rise else "flat"
    env = VelocityEnv(attrs.evolve(CALM, terrain=Terrain(kind=kind, slope=rise)))
    env._qpos[:, 3:7] = [math.cos(rise / 2), 0.0, -math.sin(rise / 2), 0.0]
    env._qpos[:, 7:] = ALIENGO.nominal_q
    env._update_state()
    env.height[:] = scripted_trot.HEIGHT_M
    return walking_feet(env, [0.5, 0.0, 0.0], [0.0, 0.0])


def test_on_a_slope_the_trunk_stays_parallel_to_the_ground_and_the_feet_are_placed_downhill(weightless):
    rise = math.radians(15.0)
    moved = feet_on_slope(rise) - feet_on_slope(0.0)
    # A plumb line from the trunk meets the slope h tan(rise) behind the middle of the nominal feet.
    behind = scripted_trot.DOWNHILL * scripted_trot.HEIGHT_M * math.tan(rise)
    assert moved[:, :2] == pytest.approx(np.tile([-behind, 0.0], (4, 1)), abs=3e-3)
    assert moved[:, 2] == pytest.approx(0.0, abs=3e-3)


def test_the_teacher_of_a_robot_that_turned_too_little_gets_a_faster_yaw_rate():
    env = VelocityEnv(CALM)
    env.command[:], past, previous = [0.5, 0.0, 1.0, 0.0], Past(env), np.zeros((4, 12))
    past.clock.walking[:], past.clock.velocity[:], past.steady[:] = True, [0.5, 0.0, 1.0], 1.0
    usual = privileged.observe(env, past, previous)
    past.lag[1:, 2] = 0.1  # rad
    added = privileged.observe(env, past, previous) - usual
    assert added[1:, [2, -1]] == pytest.approx(0.1 * CATCH_UP_TURN)  # command and plan
    assert not added[0].any()
    past.clock.walking[:] = False
    assert not past.turn_correction.any()


def test_a_robot_that_walks_sideways_places_its_feet_behind(weightless, monkeypatch):
    env = VelocityEnv(CALM)
    placed = walking_feet(env, [0.0, 0.5, 0.0], [0.0, 0.0])
    monkeypatch.setattr(scripted_trot, "SIDEWAYS_S", 0.0)
    moved = placed - walking_feet(env, [0.0, 0.5, 0.0], [0.0, 0.0])
    assert moved[:, :2] == pytest.approx(np.tile([0.0, -0.035], (4, 1)), abs=2e-3)


def test_in_a_curve_the_feet_are_placed_out_by_what_the_centripetal_acceleration_takes(weightless):
    env = VelocityEnv(CALM)
    left, right = (walking_feet(env, [1.5, 0.0, turn], [0.0, 0.0]) for turn in (1.0, -1.0))
    # a trunk at height h accelerates by g d / h towards the side from which its feet are d away
    out = scripted_trot.CURVE * 1.5 * 1.0 * 0.358 / 9.81
    assert (right - left)[:, 1].mean() == pytest.approx(2 * out, rel=0.05)


def test_feet_that_stand_push_back_and_those_that_swing_do_not(weightless, monkeypatch):
    env = VelocityEnv(CALM)
    pushing = walking_feet(env, [2.0, 0.0, 0.0], [0.0, 0.0])
    monkeypatch.setattr(scripted_trot, "BEHIND_S", np.zeros(2))
    monkeypatch.setattr(scripted_trot, "DRAG", np.zeros(2))
    back = (walking_feet(env, [2.0, 0.0, 0.0], [0.0, 0.0]) - pushing)[:, 0]
    # the feet FR and RL swing at the phase at which a clock starts, less a lead
    assert back == pytest.approx(
        [0.0, 0.092 * 0.46 + 0.0105 * 4.0, 0.092 * 0.46 + 0.0105 * 4.0, 0.0], abs=2e-3
    )


def test_a_sample_of_20_ms_is_four_ticks_of_5():
    slow, fast = VelocityEnv(CALM), VelocityEnv(attrs.evolve(CALM, period=0.005, timestep=0.0025))
    starts = [env._clock.copy() for env in (slow, fast)]
    slow.tick(np.tile(slow.stand_q, (4, 1)))
    for _ in range(4):
        fast.tick(np.tile(fast.stand_q, (4, 1)))
    for env, start in zip((slow, fast), starts, strict=True):
        assert (env._clock - start).ravel() == pytest.approx(np.full(4, 0.02))


@pytest.mark.parametrize("speed", [np.nan, np.inf, 1e4])
def test_a_robot_whose_physics_blows_up_lies_fallen_and_every_number_stays_finite(speed):
    env = VelocityEnv(CALM)
    env._qvel[1, 7] = speed
    env.tick(np.tile(env.stand_q, (4, 1)))
    assert env.broken.tolist() == [False, True, False, False]
    assert env.fallen[1]
    past = Past(env)
    past.advance(env.command)
    assert np.isfinite(privileged.observe(env, past, np.zeros((4, 12)))).all()
    terms = WalkingRewards(env, WalkingWeights()).terms(env.command, past, np.zeros((3, 4, 12)))
    assert all(np.isfinite(value).all() for value in terms.values())
    env.tick(np.tile(env.stand_q, (4, 1)))
    assert np.isfinite(env.batch.qpos).all()


def test_an_error_that_lasts_is_that_of_this_command_alone_and_without_its_beginning():
    env = VelocityEnv(CALM)
    past, error = Past(env), np.array([0.4, -0.2, 0.3])
    command = np.zeros((4, 4))
    command[:, :2], command[:, 2] = env.velocity[:, :2] + error[:2], env.angular_velocity[:, 2] + error[2]
    past.clock.velocity[:] = command[:, :3]
    env.changed[:] = False
    for _ in range(round(0.9 * TRANSIENT_S / env.config.period)):
        past.advance(command)
    assert (past.lasting == 0.0).all()
    for _ in range(round(10 * LASTING_S / env.config.period)):
        past.advance(command)
    assert past.lasting == pytest.approx(np.tile(error, (4, 1)), rel=1e-3)
    assert past.lag == pytest.approx(np.tile([MAX_LAG, -MAX_LAG, MAX_LAG], (4, 1)))
    env.changed[1] = True
    past.advance(command)
    env.changed[:] = False
    past.advance(command)
    assert (past.lasting[:, 0] == 0.0).tolist() == [False, True, False, False]


def test_a_robot_is_behind_by_what_its_plan_moved_farther_until_it_is_to_stand():
    env = VelocityEnv(CALM)
    past, command = Past(env), np.tile([0.3, 0.0, 0.0, 0.0], (4, 1))
    past.clock.velocity[:], env.velocity[:], env.angular_velocity[:] = command[:, :3], 0.0, 0.0
    seconds = 0.4
    for k in range(round(seconds / env.config.period)):
        env.changed[:] = k == 10  # a new command ends nothing
        past.advance(command)
    assert past.lag == pytest.approx(np.tile([0.3 * seconds, 0.0, 0.0], (4, 1)), abs=1e-9)
    command[:] = [0.0, 0.0, 0.0, 1.0]
    past.advance(command)
    assert not past.lag.any()


def test_the_way_behind_stays_where_it_is_in_the_world_while_the_robot_turns():
    env = VelocityEnv(CALM)
    past, command = Past(env), np.tile([0.0, 0.0, 2.0, 0.0], (4, 1))
    past.clock.velocity[:], env.velocity[:], env.angular_velocity[:] = command[:, :3], 0.0, [0.0, 0.0, 2.0]
    past.lag[:] = behind = [0.08, -0.05, 0.0]
    seconds = 0.4
    for _ in range(round(seconds / env.config.period)):
        past.advance(command)
    c, s = (
        np.cos(2.0 * seconds),
        np.sin(2.0 * seconds),
    )  # the body turns to the left, the way in it to the right
    there = [c * behind[0] + s * behind[1], c * behind[1] - s * behind[0], 0.0]
    assert past.lag == pytest.approx(np.tile(there, (4, 1)), abs=2e-3)  # integrated with 20 ms


def test_a_velocity_counts_as_steady_once_the_plan_has_reached_it_and_ends_with_a_new_command():
    env = VelocityEnv(CALM)
    past, command = Past(env), np.tile([1.0, 0.2, 0.5, 0.0], (4, 1))
    while (past.clock.velocity != command[:, :3]).any():
        assert not past.steady.any()
        past.advance(command)
    for _ in range(round(10 * STEADY_S / env.config.period)):
        past.advance(command)
    assert past.steady == pytest.approx(np.ones(4), rel=1e-3)
    command[1, 1] = -1.5
    for _ in range(round(3 * STEADY_END_S / env.config.period)):
        past.advance(command)
    assert past.steady[1] < 0.06
    assert past.steady[0] == pytest.approx(1.0, rel=1e-3)


def test_who_runs_off_rough_ground_has_no_time_left_but_has_not_fallen():
    ground = Terrain(kind="rough", roughness=0.01, size=8.0)
    env = VelocityEnv(attrs.evolve(CALM, terrain=ground))
    env._qpos[:, :2] = 0.0
    env._qpos[2, 0] = 3.9
    env._qpos[:, 2] = 0.42
    env._update_state()
    assert env.timed_out.tolist() == [False, False, True, False]
    assert not env.fallen.any()


def test_no_sample_is_worth_more_or_less_than_the_bounds():
    env = VelocityEnv(CALM)
    rewards = WalkingRewards(env, WalkingWeights(scale=1.0, fall=0.0))
    awful, great = {"one": np.full(4, -1e9)}, {"one": np.full(4, 1e9)}
    assert (rewards.total(awful, np.zeros(4, bool)) == MIN_REWARD).all()
    assert (rewards.total(great, np.zeros(4, bool)) == MAX_REWARD).all()


def test_following_turns_pays_as_following_speeds_does():
    env = VelocityEnv(CALM)
    rewards, past = WalkingRewards(env, WalkingWeights()), Past(env)
    command = np.array(
        [[0.8, 0.0, 0.0, 0.0], [0.0, 0.0, 0.8, 0.0], [0.8, 0.0, 0.0, 0.0], [0.0, 0.0, 0.8, 0.0]]
    )
    env.velocity[:], env.angular_velocity[:] = 0.0, 0.0
    env.velocity[2, 0] = env.angular_velocity[3, 2] = 0.8
    past.advance(command)
    terms = rewards.terms(command, past, np.zeros((3, 4, 12)))
    total = sum(terms[name] for name in ("linear", "angular", "stride", "lasting", "steady"))
    assert total[2] > total[0] + 0.5
    assert total[3] > total[1] + 0.5


def test_feet_are_to_step_while_walking_and_to_stay_in_stance():
    env = VelocityEnv(CALM)
    rewards, past = WalkingRewards(env, WalkingWeights()), Past(env)
    command = np.array([[0.5, 0, 0, 0], [0.5, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 1]], float)
    past.clock.phase[:], past.clock.walking[:] = 0.9, command[:, 3] < 0.5
    env.contact[:] = True
    env.contact[[1, 3], 0] = False
    terms = rewards.terms(command, past, np.zeros((3, 4, 12)))
    assert terms["schedule"][0] < terms["schedule"][1]
    assert terms["step"][3] < terms["step"][2]
    assert (terms["schedule"][2:] == 0.0).all()
    assert (terms["step"][:2] == 0.0).all()


def test_a_robot_stands_once_its_four_feet_have_been_down_for_a_while():
    env = VelocityEnv(CALM)
    past, command = Past(env), np.zeros((4, 4))
    env.contact[:] = True
    for _ in range(round(0.5 * STANDING_S / env.config.period)):
        past.advance(command)
    assert not past.standing.any()
    for _ in range(round(STANDING_S / env.config.period)):
        past.advance(command)
        env.contact[1, 2] = False
    assert past.standing.tolist() == [True, False, True, True]


def test_exploration_stays_within_bounds_that_fall():
    run = PrivilegedRun(SMALL)
    for samples, most in ((0, SMALL.std), (SMALL.std_samples, SMALL.final_std)):
        run.samples = int(samples)
        for fill, bound in ((-5.0, 0.5 * SMALL.final_std), (5.0, most)):
            with torch.no_grad():
                run.actor.log_std.fill_(fill)
            run._bound_exploration()
            assert run.actor.log_std.detach().exp().numpy() == pytest.approx(np.full(12, bound))


def test_a_killed_run_resumes_with_its_random_numbers(tmp_path):
    first = PrivilegedRun(SMALL)
    first.step(0.0)
    follow(first.grid, (1.0, 0.0, 0.0), 4)
    loop.save(first.state(), tmp_path / "privileged.pt")
    second = PrivilegedRun(SMALL)
    second.restore(loop.load(tmp_path / "privileged.pt"))
    assert second.samples == 24
    assert first.grid.followed.any()
    assert np.array_equal(second.grid.open, first.grid.open)
    assert second.ppo.learning_rate == first.ppo.learning_rate
    second.step(0.0)
    third = PrivilegedRun(SMALL)
    third.restore(loop.load(tmp_path / "privileged.pt"))
    third.step(0.0)
    for one, other in zip(second.actor.parameters(), third.actor.parameters(), strict=True):
        assert torch.equal(one, other)


def test_the_grid_hears_how_robots_of_all_processes_followed(monkeypatch, grid):
    command, fell = np.array([[1.0, 0, 0, 0], [0.5, 0, 0, 0]]), np.zeros(2, bool)
    mine, other = CommandScorer(2), CommandScorer(2)
    for _ in range(100):
        other.advance(np.zeros((2, 3)), np.ones(2, bool), 0.02)
    other.finish(command, np.ones(2, bool), fell)
    monkeypatch.setattr(process_group, "gather", lambda own: [own, other._over])
    mine.report_to(grid)
    assert grid.success[grid.cell_of(command[0, :3])] > 0.0
    monkeypatch.setattr(process_group, "gather", lambda own: [own])
    other.report_to(again := CommandGrid(GridConfig()))
    assert np.array_equal(again.success, grid.success)
    other.report_to(fresh := CommandGrid(GridConfig()))
    assert not fresh.success.any()


def test_a_quarter_of_the_robots_explores_little_and_the_learner_knows_which():
    run = PrivilegedRun(attrs.evolve(SMALL, n=40, length=12))
    rollout, _ = run.collect()
    drawn = (rollout.action - rollout.mean).std(dim=(0, 2))
    assert drawn[30:].max() < 0.5 * drawn[:30].min()
    assert torch.allclose(drawn[30:].mean() / drawn[:30].mean(), rollout.spread[-1], rtol=0.1)
    assert rollout.standing.shape == rollout.reward.shape


def test_a_checkpoint_of_another_grid_is_refused_with_both_shapes():
    state = PrivilegedRun(SMALL).state()
    other = PrivilegedRun(attrs.evolve(SMALL, grid=GridConfig(vy=0.7)))
    with pytest.raises(ValueError, match=r"command grid of .* cells, expected"):
        other.restore(state)


def test_numbered_checkpoints_are_kept(tmp_path):
    run = PrivilegedRun(attrs.evolve(SMALL, keep=1000.0))
    keeper = NumberedCheckpoints(run, tmp_path)
    assert not keeper.due(900)
    assert keeper.due(1100)
    run.samples = 1100
    keeper.keep()
    assert loop.load(tmp_path / "kept" / "000001k.pt")["samples"] == 1100


def test_hips_away_from_straight_down_cost_and_less_so_sideways():
    env = VelocityEnv(EnvConfig(robot=ALIENGO, n=2, threads=1, randomisation=Randomisation.none()))
    env.q = np.tile(ALIENGO.nominal_q, (2, 1))
    env.q[:, ::3] = [0.1, -0.2, 0.0, 0.3]
    assert hip_deviation(env, np.array([[1.0, 0.0, 0.5, 0.0], [0.0, -0.5, 0.0, 0.0]])) == pytest.approx(
        [0.6, 0.3]
    )
