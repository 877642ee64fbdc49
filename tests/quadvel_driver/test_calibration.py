"""Sensors that are off: found from a suspended and a standing robot, and set right."""

from __future__ import annotations

from pathlib import Path

import attrs
import mujoco
import numpy as np
import pytest

from quadvel_description.kinematics import roll_pitch, rotate_inverse
from quadvel_description.mjcf import Plant, load_model
from quadvel_description.state import JointCommand, RobotState
from quadvel_driver.calibration import Calibration, CalibrationError
from quadvel_driver.find_calibration import CalibrationDataError, CalibrationFit, Samples, fit_calibration
from quadvel_driver.leg_dynamics import leg_torque
from quadvel_driver.parameters import DriverParameters
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from quadvel_sysid.excitation import Creep
from tests.helpers.robots import ALIENGO

DEGREE = np.pi / 180.0
OFF = Calibration(
    joint_zeros=DEGREE * np.array([1.0, -2.0, 0.5, 0.0, 1.5, -1.0, -1.0, 0.7, 2.0, 0.4, -0.6, -1.8]),
    imu_mounting=DEGREE * np.array([2.0, -0.7]),
)


LEANING = Calibration(imu_mounting=np.array([0.03, 0.0]))


def recorded(suspended: bool, seconds: float, off: Calibration, seed: int = 3) -> list[RobotState]:
    """What a simulated robot reports whose sensors are off, driven to where they say it should go.

    Suspended, it moves as `quadvel excite creep` moves it, with the policy's soft gains.
    """
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, suspended=suspended, seed=seed))
    simulator.reset("stand")
    if suspended:
        targets, kp, kd = Creep(ALIENGO, seconds=seconds).targets(), ALIENGO.kp, ALIENGO.kd
    else:
        targets, kp, kd = np.tile(ALIENGO.nominal_q, (round(1e3 * seconds), 1)), 100.0, 3.0
    states = []
    for step in range(0, len(targets), 2):
        wanted = JointCommand(q=targets[step], kp=np.full(12, kp), kd=np.full(12, kd))
        simulator.command(off.as_executed(wanted))
        simulator.step(2)
        if step > 1000:
            states.append(off.as_reported(simulator.state()))
    return states


def fitted(off: Calibration, seed: int = 3, has_stood: bool = True) -> CalibrationFit:
    """The calibration of a simulated robot from a minute of creeping, and from standing."""
    return fit_calibration(
        ALIENGO,
        Samples.from_states(recorded(True, 60.0, off, seed)),
        Samples.from_states(recorded(False, 3.0, off, seed)) if has_stood else None,
    )


def errors_in_standard_errors(found: CalibrationFit, off: Calibration) -> np.ndarray:
    """The errors of zeros and IMU tilt over their standard errors, (14,)."""
    zeros = (found.estimate.joint_zeros - off.joint_zeros) / found.zero_errors
    return np.append(zeros, (found.estimate.imu_mounting - off.imu_mounting) / found.mounting_errors)


@pytest.fixture(scope="module")
def suspended() -> Samples:
    return Samples.from_states(recorded(True, 60.0, OFF))


@pytest.fixture(scope="module")
def standing() -> Samples:
    return Samples.from_states(recorded(False, 3.0, OFF))


def test_the_holding_torque_is_that_of_the_simulator() -> None:
    model = load_model(ALIENGO, Plant(suspended=True))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = ALIENGO.lower + rng.uniform(0.2, 0.8, 12) * (ALIENGO.upper - ALIENGO.lower)
        turn = rng.normal(size=4)
        data.qpos[3:7], data.qpos[7:], data.qvel[:] = turn / np.linalg.norm(turn), q, 0.0
        mujoco.mj_forward(model, data)
        down = rotate_inverse(data.qpos[3:7], np.array([0.0, 0.0, -1.0]))
        rest = np.zeros((1, 3))
        legs = enumerate(q.reshape(4, 1, 3))
        torque = np.ravel([leg_torque(ALIENGO, leg, angles, rest, rest, down[None]) for leg, angles in legs])
        np.testing.assert_allclose(torque, data.qfrc_bias[6:], atol=1e-9)


def test_the_torque_of_a_moving_leg_is_that_of_the_simulator() -> None:
    model = load_model(ALIENGO, Plant(suspended=True))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    q = ALIENGO.lower + rng.uniform(0.2, 0.8, 12) * (ALIENGO.upper - ALIENGO.lower)
    dq, ddq = rng.normal(size=(2, 12))
    data.qpos[3:7], data.qpos[7:], data.qvel[6:] = [1.0, 0.0, 0.0, 0.0], q, dq
    mujoco.mj_forward(model, data)
    inertia = np.zeros(18)
    mujoco.mj_mulM(model, data, inertia, np.append(np.zeros(6), ddq))
    angles, speeds, accelerations = (values.reshape(4, 1, 3) for values in (q, dq, ddq))
    down = np.array([[0.0, 0.0, -1.0]])
    torque = np.ravel(
        [leg_torque(ALIENGO, leg, angles[leg], speeds[leg], accelerations[leg], down) for leg in range(4)]
    )
    np.testing.assert_allclose(torque, (data.qfrc_bias + inertia)[6:], atol=1e-9)


def test_zeros_and_mounting_are_found_together(suspended: Samples, standing: Samples) -> None:
    found = fit_calibration(ALIENGO, suspended, standing)
    off = errors_in_standard_errors(found, OFF)
    assert np.abs(off).max() < 3.0
    assert np.sqrt(np.mean(off**2)) < 1.5  # the standard errors match the actual errors
    assert (found.zero_errors < 1.0 * DEGREE).all()
    assert (found.mounting_errors < 1.0 * DEGREE).all()
    assert found.unevenness < 0.005
    np.testing.assert_array_equal(found.calibration.joint_zeros, found.estimate.joint_zeros)


def test_an_imu_that_leans_by_two_degrees_is_found_from_standing_alone() -> None:
    leaning = Calibration(imu_mounting=DEGREE * np.array([2.0, 0.0]))
    found = fit_calibration(ALIENGO, None, Samples.from_states(recorded(False, 3.0, leaning)))
    np.testing.assert_allclose(found.calibration.imu_mounting, leaning.imu_mounting, atol=0.1 * DEGREE)
    assert not found.calibration.joint_zeros.any()


@pytest.mark.parametrize("has_stood", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_robot_whose_sensors_are_right_is_not_corrected(has_stood: bool) -> None:
    found = fitted(Calibration(), has_stood=has_stood)
    assert not found.calibration.joint_zeros.any()
    assert not found.calibration.imu_mounting.any()
    assert np.abs(errors_in_standard_errors(found, Calibration())).max() < 3.0


@pytest.mark.long
def test_a_leaning_imu_is_not_taken_for_joints_that_are_off() -> None:
    found = fitted(LEANING)
    assert not found.calibration.joint_zeros.any()
    np.testing.assert_allclose(found.calibration.imu_mounting, LEANING.imu_mounting, atol=0.2 * DEGREE)


@pytest.mark.long
def test_a_leaning_imu_of_a_suspended_robot_is_found_for_encoders_that_are_right() -> None:
    found = fitted(LEANING, has_stood=False)
    assert not found.calibration.joint_zeros.any()
    assert found.tilt_errors[0] < found.mounting_errors[0]
    assert np.abs(found.tilt - LEANING.imu_mounting)[0] < 3.0 * found.tilt_errors[0]
    assert found.calibration.imu_mounting[0] == found.tilt[0]


@pytest.mark.long
def test_an_offset_of_the_measured_torques_is_not_taken_for_joints_that_are_off() -> None:
    right = Samples.from_states(recorded(True, 60.0, Calibration()))
    found = fit_calibration(ALIENGO, attrs.evolve(right, tau=right.tau + 0.03), None)
    assert not found.calibration.joint_zeros.any()


@pytest.mark.long
def test_nineteen_of_twenty_offsets_lie_within_two_standard_errors() -> None:
    rng = np.random.default_rng(1)
    errors = []
    for seed in range(8):
        off = Calibration(rng.normal(0.0, DEGREE, 12), rng.normal(0.0, DEGREE, 2))
        errors.append(errors_in_standard_errors(fitted(off, seed), off))
    assert np.mean(np.abs(errors) < 2.0) >= 0.95


def test_what_is_set_right_is_what_was(standing: Samples) -> None:
    simulator = Simulator(SimulatorConfig(robot=ALIENGO))
    simulator.reset("stand")
    state = simulator.state()
    back = OFF.apply(OFF.as_reported(state))
    for field in ("q", "quaternion", "angular_velocity", "linear_acceleration"):
        np.testing.assert_allclose(getattr(back, field), getattr(state, field), atol=1e-12)
    command = JointCommand(q=np.array(ALIENGO.nominal_q))
    np.testing.assert_allclose(OFF.as_executed(OFF.invert(command)).q, command.q)


def test_an_imu_that_leans_to_the_right_shows_a_level_robot_rolling_to_the_right() -> None:
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, suspended=True))
    simulator.reset("stand")
    shown = Calibration(imu_mounting=np.array([0.1, 0.0])).as_reported(simulator.state())
    np.testing.assert_allclose(roll_pitch(shown.quaternion), [0.1, 0.0], atol=0.01)


def test_the_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_text(OFF.to_yaml())
    read = Calibration.load(file)
    np.testing.assert_allclose(read.joint_zeros, OFF.joint_zeros, atol=1e-5)
    np.testing.assert_allclose(read.imu_mounting, OFF.imu_mounting, atol=1e-5)


def test_a_driver_refuses_the_calibration_of_another_robot(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_text(attrs.evolve(OFF, robot="go2").to_yaml())
    assert DriverParameters(robot="go2", calibration=str(file)).load_calibration().robot == "go2"
    with pytest.raises(CalibrationError, match="robot is 'go2', expected 'aliengo'"):
        DriverParameters(calibration=str(file)).load_calibration()
    file.write_text(OFF.to_yaml().replace("robot: aliengo\n", ""))  # older than the names
    assert DriverParameters(calibration=str(file)).load_calibration().robot == "aliengo"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("schema: 2", "expected the fields of a calibration with schema: 1"),
        ("[1, 2]", "expected the fields of a calibration"),
        (OFF.to_yaml().replace("FR_hip_joint", "hip"), "has other names than the twelve joints"),
        (OFF.to_yaml().replace("roll: 0.03491", "roll: .nan"), "imu_mounting: roll nan rad"),
        (OFF.to_yaml().replace("roll: 0.03491", "roll: 1.5"), "expected 2 angles within 0.35 rad"),
        (OFF.to_yaml().replace("roll: 0.03491", "roll: [1]"), "TypeError"),
        ("{", "calibration.yaml: no valid YAML"),
    ],
)
def test_a_file_that_is_none_is_refused_by_name(tmp_path: Path, text: str, sentence: str) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_text(text)
    with pytest.raises(CalibrationError, match=sentence) as refused:
        Calibration.load(file)
    assert str(file) in str(refused.value)


def test_recordings_that_tell_nothing_are_refused(suspended: Samples, standing: Samples) -> None:
    with pytest.raises(
        CalibrationDataError, match="FR_hip_joint hardly moves to and fro; record quadvel excite creep"
    ):
        fit_calibration(ALIENGO, standing, None)
    with pytest.raises(CalibrationDataError, match="rad/s, expected a robot that stands still"):
        fit_calibration(ALIENGO, None, attrs.evolve(suspended, dq=suspended.dq + 0.5))
    with pytest.raises(CalibrationDataError, match="3 states, expected 100 at least"):
        Samples.from_states(recorded(False, 1.02, OFF)[:3])
