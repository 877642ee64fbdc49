"""Tests of the simulated robot against closed forms: flight, pushes, drives, sensors, watchdog."""

from itertools import pairwise
from pathlib import Path

import attrs
import mujoco
import numpy as np
import pytest

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_description.kinematics import foot_positions, rotate, rotate_inverse
from quadvel_description.mjcf import gravity_torque
from quadvel_description.quadruped import GRAVITY, LEGS
from quadvel_description.state import MODE_DAMPING, JointCommand, RobotState
from quadvel_sim.config import SensorNoise, SimulatorConfig
from quadvel_sim.simulator import DT, Simulator
from quadvel_sim.terrain import Terrain
from tests.helpers.robots import ALIENGO

G = GRAVITY


def simulator(**fields: object) -> Simulator:
    """Noise-free sensors and, by default, ideal drives."""
    defaults: dict[str, object] = {"noise": SensorNoise.none(), "actuator": ActuatorParameters.ideal(ALIENGO)}
    return Simulator(SimulatorConfig(robot=ALIENGO, **{**defaults, **fields}))


def hold(kp: float = 150.0, kd: float = 4.0, q: np.ndarray | None = None, **fields: object) -> JointCommand:
    """A posture, the nominal one where `q` is None."""
    q = ALIENGO.nominal_q if q is None else q
    return JointCommand(q=q, kp=np.full(12, kp), kd=np.full(12, kd), **fields)


def fly(sim: Simulator, height: float = 2.0) -> None:
    """Put the robot high up, where nothing touches."""
    sim.reset("stand")
    sim.data.qpos[2] += height


def run(sim: Simulator, command: JointCommand, seconds: float) -> None:
    for _ in range(round(seconds / 0.005)):
        sim.command(command)
        sim.step(5)


def wiggle(sim: Simulator, k: int) -> JointCommand:
    """A smooth motion of all joints."""
    phase = 2.0 * np.pi * 3.0 * k * DT + np.arange(12)
    return hold(60.0, 1.0, ALIENGO.nominal_q + 0.3 * np.sin(phase))


def momentum(sim: Simulator) -> np.ndarray:
    """Linear momentum of the whole robot, world frame, N s."""
    mujoco.mj_forward(sim.model, sim.data)
    mujoco.mj_subtreeVel(sim.model, sim.data)
    return sim.model.body_subtreemass[1] * sim.data.subtree_linvel[1]


# motion


def test_a_dropped_robot_falls_as_galilei_says() -> None:
    sim = simulator(joint_friction=0.0)
    fly(sim)
    sim.command(hold())
    start = sim.truth()
    run(sim, hold(), 0.5)
    centre = sim.data.subtree_com[1].copy()
    end = sim.truth()
    np.testing.assert_allclose(momentum(sim), [0.0, 0.0, -ALIENGO.mass * G * 0.5], atol=1e-6)
    # semi-implicit Euler falls by half a step's worth of speed more
    drop = 0.5 * G * 0.5**2 + 0.5 * G * 0.5 * DT
    assert start.position[2] - end.position[2] == pytest.approx(drop, abs=2e-3)  # legs swing a little
    assert np.linalg.norm(centre[:2]) < 0.02
    assert not end.contact.any()


def test_energy_of_a_falling_robot_with_rigid_joints_is_kept() -> None:
    sim = simulator(joint_friction=0.0, joint_damping=0.0)
    fly(sim)
    sim.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    mujoco.mj_forward(sim.model, sim.data)
    before = sim.data.energy.sum()
    run(sim, JointCommand(), 0.3)
    mujoco.mj_forward(sim.model, sim.data)
    assert sim.data.energy[1] > 100.0
    assert sim.data.energy.sum() == pytest.approx(before, abs=0.005 * sim.data.energy[1])


@pytest.mark.parametrize("body", ["trunk", "FR_calf"])
def test_a_push_gives_its_impulse(body: str) -> None:
    sim = simulator()
    fly(sim)
    sim.push(body, [60.0, -20.0, 30.0], duration=0.1)
    sim.push(body, [0.0, 10.0, 0.0], duration=0.05)
    run(sim, hold(), 0.3)
    expected = 0.1 * np.array([60.0, -20.0, 30.0]) + 0.05 * np.array([0.0, 10.0, 0.0])
    np.testing.assert_allclose(momentum(sim), expected - [0.0, 0.0, ALIENGO.mass * G * 0.3], atol=0.01)
    assert not sim.data.xfrc_applied.any()


def test_a_push_with_a_torque_gives_its_angular_impulse() -> None:
    sim = simulator()
    fly(sim)
    sim.push("trunk", np.zeros(3), [0.0, 0.0, 5.0], duration=0.1)
    run(sim, hold(kp=400.0, kd=10.0), 0.15)
    mujoco.mj_forward(sim.model, sim.data)
    mujoco.mj_subtreeVel(sim.model, sim.data)
    assert sim.data.subtree_angmom[1][2] == pytest.approx(0.5, abs=0.01)


def test_a_failed_drive_has_no_torque_and_measures_none_until_the_reset() -> None:
    sim = simulator()
    sim.reset("stand")
    sim.fail_joint("FL_thigh_joint")
    sim.command(hold())
    for _ in range(200):
        sim.step()
        assert sim.data.ctrl[4] == 0.0
        assert sim.state().tau[4] == 0.0
    assert abs(sim.state().q[4] - ALIENGO.nominal_q[4]) > 0.05  # the leg gives way
    assert abs(sim.state().tau[5]) > 0.1
    sim.reset("stand")
    run(sim, hold(), 0.1)
    assert abs(sim.state().tau[4]) > 0.1


def test_a_jammed_joint_hardly_moves_until_the_reset() -> None:
    sim = simulator(suspended=True)
    moved = []
    for jammed in (True, False):
        sim.reset("stand")
        if jammed:
            sim.jam_joint("RR_calf_joint")
        run(sim, hold(q=ALIENGO.nominal_q + 0.3), 0.04)
        moved.append(sim.state().q - ALIENGO.nominal_q)
    assert moved[0][8] < 0.3 * moved[1][8]
    np.testing.assert_allclose(np.delete(moved[0], 8), np.delete(moved[1], 8), atol=0.02)


@pytest.mark.parametrize("torque", [36.0, -36.0])
def test_the_largest_torque_does_not_move_a_jammed_joint(torque: float) -> None:
    sim = simulator(suspended=True)
    sim.reset("stand")
    sim.jam_joint("RR_calf_joint")
    before = sim.data.qpos[7 + 8]
    pushing = hold()
    pushing.kp[8] = pushing.kd[8] = 0.0
    pushing.tau[8] = torque
    run(sim, pushing, 0.3)
    assert abs(sim.data.qpos[7 + 8] - before) < 1e-4
    assert abs(sim.state().tau[8] - torque) < 1.0


def test_faults_of_unknown_joints_are_refused() -> None:
    sim = simulator()
    for inject in (sim.fail_joint, sim.jam_joint):
        with pytest.raises(ValueError, match="joint names: found 'tail'"):
            inject("tail")


@pytest.mark.parametrize("keyframe", ["lie", "stand"])
def test_reset_puts_the_robot_at_rest_with_its_feet_on_the_ground(keyframe: str) -> None:
    sim = simulator()
    run(sim, hold(), 0.2)
    sim.push("trunk", [500.0, 0.0, 0.0], duration=1.0)
    sim.reset(keyframe)
    state, truth = sim.state(), sim.truth()
    assert (sim.time, state.time, state.tick, sim.braking) == (0.0, 0.0, 0, True)
    np.testing.assert_array_equal(state.dq, 0.0)
    feet = truth.position + foot_positions(ALIENGO, state.q)
    np.testing.assert_allclose(feet[:, 2], ALIENGO.foot_radius, atol=2e-3)
    assert not sim.data.xfrc_applied.any()


def test_a_held_posture_with_gravity_fed_forward_keeps_its_height() -> None:
    sim = simulator(actuator=ActuatorParameters.of(ALIENGO))
    sim.reset("stand")
    run(sim, hold(tau=gravity_torque(sim.model)), 1.0)
    truth = sim.truth()
    assert truth.position[2] == pytest.approx(ALIENGO.nominal_height, abs=0.005)
    assert truth.contact.all()
    assert truth.contact_force.sum(axis=0) == pytest.approx([0.0, 0.0, ALIENGO.mass * G], abs=12.0)
    assert not sim.fallen


def test_a_payload_adds_its_weight_and_moves_the_centre_of_mass() -> None:
    bare, laden = simulator(), simulator(payload=5.0, payload_position=(0.2, 0.0, 0.1))
    assert laden.model.body_subtreemass[1] == pytest.approx(ALIENGO.mass + 5.0)
    for sim in (bare, laden):
        sim.reset("stand")
        sim.state()
    moment = ALIENGO.mass * bare.data.subtree_com[1] + 5.0 * np.array(
        [0.2, 0.0, ALIENGO.nominal_height + 0.1]
    )
    np.testing.assert_allclose(laden.data.subtree_com[1], moment / (ALIENGO.mass + 5.0), atol=1e-9)


def test_a_negative_payload_is_taken_off_the_trunk_and_leaves_its_centre_of_mass() -> None:
    bare, light = simulator(), simulator(payload=-2.0)
    trunk = bare.model.body("trunk").id
    share = 1.0 - 2.0 / bare.model.body_mass[trunk]
    assert light.model.body_subtreemass[1] == pytest.approx(ALIENGO.mass - 2.0)
    np.testing.assert_allclose(light.model.body_inertia[trunk], share * bare.model.body_inertia[trunk])
    np.testing.assert_allclose(light.model.body_ipos[trunk], bare.model.body_ipos[trunk])


@pytest.mark.parametrize(("friction", "slides"), [(0.15, True), ((0.9, 0.9, 0.9, 0.9), False)])
def test_on_a_slope_the_robot_slides_where_friction_is_too_low(friction: float, slides: bool) -> None:
    sim = simulator(friction=friction, terrain=Terrain("slope", slope=0.3))
    sim.reset("stand")
    run(sim, hold(400.0, 10.0, tau=gravity_torque(sim.model)), 0.5)
    way = -sim.data.geom("RL_foot").xpos[0] - 0.2407 * np.cos(0.3)
    steady = 0.5 * G * (np.sin(0.3) - 0.15 * np.cos(0.3)) * 0.5**2
    assert way == pytest.approx(steady * np.cos(0.3) if slides else 0.0, abs=0.03)


def test_feet_do_not_creep_where_friction_holds_them() -> None:
    """The solver's friction is soft: pyramids of it let feet go downhill by 2 cm in a second on 15 degrees."""
    sim = simulator(friction=0.8, terrain=Terrain("slope", slope=np.radians(15.0)))
    sim.reset("stand")
    stiff = hold(400.0, 10.0, tau=gravity_torque(sim.model))
    feet = []
    for seconds in (0.5, 1.0):
        run(sim, stiff, seconds)
        feet.append([sim.data.geom(f"{leg}_foot").xpos.copy() for leg in LEGS])
    assert np.linalg.norm(np.subtract(*feet), axis=1).max() < 0.002


def test_each_foot_has_its_own_friction() -> None:
    sim = simulator(friction=[0.1, 0.2, 0.3, 0.4])
    assert [sim.model.geom(f"{leg}_foot").friction[0] for leg in LEGS] == [0.1, 0.2, 0.3, 0.4]


@pytest.mark.parametrize(
    "terrain", [Terrain("slope", slope=0.2), Terrain("rough", slope=-0.1, size=8.0, seed=2)]
)
def test_the_robot_stands_along_the_slope_on_its_ground(terrain: Terrain) -> None:
    sim = simulator(terrain=terrain, friction=1.0)
    sim.reset("stand")
    run(sim, hold(300.0, 8.0, tau=gravity_torque(sim.model)), 0.5)
    truth, state = sim.truth(), sim.state()
    up, ground_up = (
        rotate(truth.quaternion, np.array([0, 0, 1.0])),
        rotate(terrain.tilt, np.array([0, 0, 1.0])),
    )
    assert up @ ground_up > np.cos(0.03)
    feet = truth.position + rotate(truth.quaternion, foot_positions(ALIENGO, state.q))
    gaps = (feet[:, 2] - terrain.height(feet[:, 0], feet[:, 1])) * np.cos(terrain.slope)
    np.testing.assert_allclose(gaps, ALIENGO.foot_radius, atol=2e-3)
    assert truth.contact.all()
    # what the sensor calls normal force is across the ground
    np.testing.assert_allclose(truth.contact_force @ ground_up, state.foot_force, rtol=0.05)


def test_fallen_means_belly_on_the_ground_or_too_much_tilt() -> None:
    sim = simulator()
    sim.reset("stand")
    assert not sim.fallen
    for tilt, fallen in ((0.9, False), (1.1, True)):
        fly(sim)
        sim.data.qpos[3:7] = [np.cos(tilt / 2), np.sin(tilt / 2), 0.0, 0.0]
        assert sim.fallen == fallen
    sim.reset("stand")
    sim.data.qpos[2] = 0.05
    assert sim.fallen


# drives


def test_a_joint_at_rest_gets_the_torque_of_the_deviating_gains() -> None:
    parameters = attrs.evolve(ActuatorParameters.of(ALIENGO), torque_noise=0.0)
    sim = simulator(actuator=parameters, armature=1e9)  # nothing moves
    sim.reset("stand")
    command = hold(20.0, 0.5, ALIENGO.nominal_q + 0.1, tau=np.full(12, 0.3))
    run(sim, command, 0.1)
    state = sim.state()
    np.testing.assert_allclose(state.tau, 20.0 * (1.0 - 0.706 / 30.0) * 0.1 + 0.3, atol=1e-6)


def test_the_drives_follow_the_actuator_model_on_each_millisecond_whenever_commands_come() -> None:
    sim = simulator(actuator=ActuatorParameters.of(ALIENGO), seed=4)
    seeds = np.random.SeedSequence(4).generate_state(2)
    model = ActuatorModel(ActuatorParameters.of(ALIENGO), dt=DT, seed=int(seeds[0]))
    sim.reset("stand")
    rng = np.random.default_rng(0)
    braking = JointCommand.damping(sim.config.watchdog_kd)
    command, next_command = braking, 4
    for k in range(200):
        if k == next_command:
            command = hold(30.0, 0.5, ALIENGO.nominal_q + 0.1 * rng.normal(size=12))
            sim.command(command)
            next_command += int(rng.integers(1, 15))
        state = sim.state()
        torque = model.step(state.q, state.dq, command.q, command.kp, command.kd, command.dq, command.tau)
        np.testing.assert_allclose(state.tau, torque, atol=1e-12)
        sim.step()


def test_a_command_counts_from_the_instant_at_which_it_is_given() -> None:
    sim = simulator(armature=1e9)
    sim.reset("stand")
    sim.state()
    sim.command(hold(10.0, 0.0, ALIENGO.nominal_q + 0.2))
    sim.step(1)
    np.testing.assert_allclose(sim.data.qfrc_actuator[6:], 2.0, atol=1e-9)


def test_without_commands_the_drives_brake_after_the_watchdog_time_and_not_before() -> None:
    sim = simulator(watchdog=0.02, watchdog_kd=3.0)
    fly(sim)
    sim.command(hold(20.0, 0.0, ALIENGO.nominal_q + 0.3))
    for k in range(25):
        assert sim.braking == (k >= 20)
        q, dq = sim.data.qpos[7:].copy(), sim.data.qvel[6:].copy()
        expected = -3.0 * dq if k >= 20 else 20.0 * (ALIENGO.nominal_q + 0.3 - q)
        np.testing.assert_allclose(sim.state().tau, expected, atol=1e-9)
        sim.step()
        np.testing.assert_allclose(sim.data.qfrc_actuator[6:], expected, atol=1e-9)
    assert np.abs(dq).max() > 0.5
    sim.command(hold())
    assert not sim.braking


def test_damping_mode_ignores_stiffness_and_feedforward() -> None:
    sim = simulator()
    fly(sim)
    sim.data.qvel[6:] = 1.0
    sim.command(hold(50.0, 2.0, ALIENGO.nominal_q + 0.3, tau=np.full(12, 5.0), mode=MODE_DAMPING))
    np.testing.assert_allclose(sim.state().tau, -2.0, atol=1e-9)


def test_a_braking_robot_sinks_slowly_and_comes_to_rest() -> None:
    sim = simulator(actuator=ActuatorParameters.of(ALIENGO))
    sim.reset("stand")
    speeds = []
    for _ in range(120):  # legs folded below it, it stays up for some seconds
        sim.step(50)
        speeds.append(np.abs(sim.state().dq).max())
    assert max(speeds) < 6.0
    assert speeds[-1] < 0.1
    assert sim.fallen


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"q": np.zeros(11)}, "JointCommand.q: found .*, expected 12 finite numbers"),
        ({"kd": np.full(12, np.nan)}, "JointCommand.kd: found .*, expected 12 finite numbers"),
        ({"mode": 3}, "JointCommand.mode: found 3, expected 0 or 10"),
    ],
)
def test_a_bad_command_is_refused_and_leaves_the_one_before_in_force(change: dict, sentence: str) -> None:
    sim = simulator()
    sim.reset("stand")
    sim.command(hold())
    with pytest.raises(ValueError, match=sentence):
        sim.command(attrs.evolve(hold(), **change))
    assert not sim.braking


# sensors


def samples(sim: Simulator, count: int) -> list[RobotState]:
    """States at each of `count` ms in flight with all joints in smooth motion and the trunk turning."""
    fly(sim, 20.0)
    sim.data.qvel[3:6] = [0.8, -0.5, 1.1]
    found = []
    for k in range(count):
        sim.command(wiggle(sim, k))
        found.append(sim.state())
        sim.step()
    return found


def test_all_channels_of_a_sample_belong_to_one_instant() -> None:
    """The differences of angles and orientations agree with the rates; a shift of half a step would show."""
    sim = simulator()
    states = samples(sim, 200)
    q, dq = (np.array([getattr(s, name) for s in states]) for name in ("q", "dq"))
    rate = np.array([s.angular_velocity for s in states])
    shift = 0.5 * DT * np.abs(np.gradient(dq, DT, axis=0)).mean()  # what half a step of shift would make
    # semi-implicit Euler: q[k + 1] - q[k] = DT dq[k + 1], so the backward difference is exact
    np.testing.assert_allclose(np.diff(q, axis=0) / DT, dq[1:], atol=1e-9)
    assert shift > 1e-3
    x_axis, y_axis, z_axis = (  # of each frame in the one before
        np.array([rotate_inverse(a.quaternion, rotate(b.quaternion, axis)) for a, b in pairwise(states)])
        for axis in np.eye(3)
    )
    spin = np.stack([y_axis[:, 2], z_axis[:, 0], x_axis[:, 1]], axis=1) / DT
    np.testing.assert_allclose(spin, rate[1:], atol=2e-3)


def test_the_accelerometer_tells_the_change_of_velocity_and_gravity_at_its_instant() -> None:
    sim = simulator(joint_damping=0.0, joint_friction=0.0)
    fly(sim, 20.0)
    sim.data.qvel[3:6] = [0.8, -0.5, 1.1]
    accelerations, velocities, quaternions = [], [], []
    for k in range(150):
        sim.command(wiggle(sim, k))
        accelerations.append(sim.state().linear_acceleration)
        truth = sim.truth()
        velocities.append(rotate(truth.quaternion, truth.linear_velocity))
        quaternions.append(truth.quaternion)
        sim.step()
    felt = np.array([rotate(q, a) for q, a in zip(quaternions, accelerations, strict=True)])
    expected = np.diff(velocities, axis=0) / DT + [
        0.0,
        0.0,
        G,
    ]  # explicit in the acceleration: forward difference
    np.testing.assert_allclose(felt[:-1], expected, atol=1e-6)
    assert np.abs(np.diff(felt, axis=0)).mean() > 0.01  # one step of shift would show


def test_at_rest_the_imu_feels_gravity_upward_and_the_feet_the_weight() -> None:
    sim = simulator()
    sim.reset("stand")
    run(sim, hold(tau=gravity_torque(sim.model)), 1.0)
    state = sim.state()
    np.testing.assert_allclose(rotate(state.quaternion, state.linear_acceleration), [0.0, 0.0, G], atol=0.05)
    assert state.foot_force.sum() == pytest.approx(ALIENGO.mass * G, rel=0.01)


def test_truth_is_the_motion_of_the_trunk_origin_in_the_body_frame() -> None:
    sim = simulator()
    fly(sim)
    sim.data.qvel[3:6] = [0.3, -0.8, 2.0]
    for _ in range(200):
        before = sim.truth()
        sim.command(hold())
        sim.step()
        after = sim.truth()
        moved = (after.position - before.position) / DT
        np.testing.assert_allclose(rotate(after.quaternion, after.linear_velocity), moved, atol=1e-9)
    np.testing.assert_allclose(sim.state().angular_velocity, after.angular_velocity, atol=1e-12)


def test_sensor_noise_has_its_standard_deviations_and_tau_and_truth_have_none() -> None:
    noise = SensorNoise(q=0.01, dq=0.2, angular_velocity=0.05, linear_acceleration=0.3, orientation=0.02)
    clean, noisy = simulator(), simulator(noise=noise)
    for sim in (clean, noisy):
        sim.reset("stand")
    reference, drawn = clean.state(), [noisy.state() for _ in range(2000)]
    for name in ("q", "dq", "angular_velocity", "linear_acceleration"):
        errors = np.array([getattr(s, name) for s in drawn]) - getattr(reference, name)
        assert errors.std() == pytest.approx(getattr(noise, name), rel=0.05)
        assert abs(errors.mean()) < 0.1 * errors.std()
    vectors = np.array([s.quaternion for s in drawn])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0)
    assert (2.0 * vectors[:, 1:]).std() == pytest.approx(0.02, rel=0.05)
    np.testing.assert_array_equal(drawn[0].tau, reference.tau)
    np.testing.assert_array_equal(noisy.truth().position, clean.truth().position)


# reproducibility


def trace(sim: Simulator, read_every: int) -> np.ndarray:
    rows = []
    for k in range(60):
        sim.command(hold(40.0, 1.0, ALIENGO.nominal_q + 0.1 * np.sin(0.1 * k)))
        for i in range(5):
            if read_every and (5 * k + i) % read_every == 0:
                sim.state(), sim.truth(), sim.fallen
            sim.step()
        rows.append(sim.data.qpos.copy())
    return np.array(rows)


def test_a_reset_gives_the_same_run_to_the_bit_however_often_it_is_read() -> None:
    sim = Simulator(SimulatorConfig(robot=ALIENGO, seed=3))
    sim.reset("stand")
    first = trace(sim, 0)
    for read_every in (1, 7):
        sim.reset("stand")
        np.testing.assert_array_equal(trace(sim, read_every), first)
    other = Simulator(SimulatorConfig(robot=ALIENGO, seed=3))
    other.reset("stand")
    np.testing.assert_array_equal(trace(other, 5), first)


def test_another_seed_gives_another_run_and_its_number_brings_it_back() -> None:
    sim = Simulator(SimulatorConfig(robot=ALIENGO, seed=3))
    runs = []
    for seed in (None, 8, 3, 8):
        sim.reset("stand", seed=seed)
        noise = sim.state().q
        runs.append((trace(sim, 0), noise))
    for i, j in ((0, 2), (1, 3)):
        np.testing.assert_array_equal(runs[i][0], runs[j][0])
        np.testing.assert_array_equal(runs[i][1], runs[j][1])
    assert np.abs(runs[0][0] - runs[1][0]).max() > 1e-6
    assert np.abs(runs[0][1] - runs[1][1]).max() > 1e-6


# refusals


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        (
            {"friction": [0.5, 0.5]},
            r"SimulatorConfig.friction: found shape \(2,\), expected one number or a list of 4",
        ),
        ({"friction": -0.1}, "SimulatorConfig.friction: found .*, expected finite numbers, at least 0"),
        ({"watchdog": 0.0}, "SimulatorConfig.watchdog: found 0.0, expected at least 0.001"),
        ({"payload": float("nan")}, "SimulatorConfig.payload: found nan, expected -8 to 50"),
        ({"seed": 1.5}, "SimulatorConfig.seed: found 1.5, expected a whole number, at least 0"),
    ],
)
def test_a_bad_configuration_is_refused_by_name(fields: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        SimulatorConfig(robot=ALIENGO, **fields)


def test_bad_orders_are_refused_by_name() -> None:
    sim = simulator()
    with pytest.raises(ValueError, match="keyframe: found 'sit', expected one of stand, lie"):
        sim.reset("sit")
    with pytest.raises(ValueError, match="push: body: found 'tail', expected one of trunk, FR_hip"):
        sim.push("tail", [1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="push: wrench: found"):
        sim.push("trunk", [np.inf, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"push: duration: found 0\.0 s, expected at least 0\.001 s"):
        sim.push("trunk", [1.0, 0.0, 0.0], duration=0.0)
    sim.push("trunk", [2000.0, 0.0, 0.0])
    with pytest.raises(
        ValueError, match="push: force: found 2800 N of all pushes together, expected at most 2446"
    ):
        sim.push("RL_calf", [0.0, 0.0, -800.0])
    with pytest.raises(ValueError, match=r"push: torque: found 60 N m .* at most 48"):
        sim.push("trunk", np.zeros(3), [60.0, 0.0, 0.0])


def test_a_diverged_run_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log where it stands
    sim = simulator()
    sim.reset("stand")
    sim.data.qvel[0] = np.nan
    with pytest.raises(FloatingPointError, match=r"not finite at 0\.001 s"):
        sim.step()
