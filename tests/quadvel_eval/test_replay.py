"""A replay with the true model has a small error, with another model a larger one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import attrs
import numpy as np
import pytest
from mcap.writer import Writer

from quadvel_actuator import ActuatorParameters
from quadvel_description.state import MODE_SERVO, JointCommand
from quadvel_eval.replay import (
    COMMAND_FIELDS,
    JointRecord,
    open_loop_error,
    read_joints,
    torque_error,
    tracking_gap,
)
from quadvel_eval.segments import Segment
from quadvel_recordings.definitions import STORE
from quadvel_sim import SensorNoise, Simulator, SimulatorConfig, Truth
from tests.helpers.robots import ALIENGO

SECONDS = 1.5
LowState, LowCmd = "quadvel_msgs/msg/LowState", "quadvel_msgs/msg/LowCmd"


@pytest.fixture(scope="module")
def run() -> tuple[JointRecord, Callable[[float], Truth]]:
    """A robot with the shipped drives that sways on its feet under commands at 200 Hz, without noise."""
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, noise=SensorNoise.none(), seed=3))
    simulator.reset("stand")
    states, truths, rows = [], [], []
    sway = np.tile([0.1, 0.15, -0.2], 4)
    for step in range(round(SECONDS * 1000)):
        if step % 5 == 0:
            target = ALIENGO.nominal_q + sway * np.sin(2 * np.pi * 2.0 * step * 0.001)
            command = JointCommand(q=target, kp=np.full(12, ALIENGO.kp), kd=np.full(12, ALIENGO.kd))
            command.dq, command.tau = 0.5 * sway, 8.0 * sway
        simulator.command(command)
        states.append(simulator.state())
        truths.append(simulator.truth())
        rows.append(np.concatenate([*(getattr(command, field) for field in COMMAND_FIELDS), [MODE_SERVO]]))
        simulator.step()
    time = np.array([state.time for state in states])
    q, dq, tau = (np.array([getattr(state, name) for state in states]) for name in ("q", "dq", "tau"))
    return JointRecord(time, q, dq, tau, np.array(rows), np.ones(len(time), bool)), lambda t: truths[
        round(1000 * t)
    ]


def write_recording(path: Path, ticks: list[int], answered: list[int]) -> None:
    """States whose q is their tick in s, at `ticks`, and commands that answer `answered`, all stamped alike."""
    zero = np.zeros(12, np.float32)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        for topic, kind, sent in (("/low_state", LowState, ticks), ("/low_cmd", LowCmd, answered)):
            text, _ = STORE.generate_msgdef(kind, ros_version=2)
            channel = writer.register_channel(
                topic, "cdr", writer.register_schema(kind, "ros2msg", text.encode())
            )
            for tick in sent:
                fields = {"stamp": STORE.types["builtin_interfaces/msg/Time"](0, tick * 10**6), "tick": tick}
                q = np.full(12, 1e-3 * tick, np.float32)
                if kind == LowCmd:
                    fields |= {
                        "mode": MODE_SERVO,
                        "q": q,
                        "dq": zero,
                        "tau": zero,
                        "kp": zero + 30,
                        "kd": zero,
                    }
                else:
                    vectors = dict.fromkeys(
                        ("angular_velocity", "linear_acceleration"), np.zeros(3, np.float32)
                    )
                    fields |= {
                        "q": q,
                        "dq": zero,
                        "tau": zero,
                        "orientation_wxyz": np.eye(4, dtype=np.float32)[0],
                    }
                    fields |= {**vectors, "foot_force": np.zeros(4, np.float32)}
                data = bytes(STORE.serialize_cdr(STORE.types[kind](**fields), kind))
                writer.add_message(channel, tick * 10**6, data, tick * 10**6)
        writer.finish()


def test_missing_states_are_marked_and_commands_stay_in_force(tmp_path: Path) -> None:
    write_recording(tmp_path / "walk.mcap", [5, 6, 7, 10, 11, 12], answered=[6, 10])
    joints = read_joints(tmp_path / "walk.mcap")
    np.testing.assert_allclose(joints.time, np.arange(5, 13) * 1e-3)
    np.testing.assert_allclose(joints.q[:, 3], joints.time, atol=1e-8)
    assert joints.recorded.tolist() == [True] * 3 + [False] * 2 + [True] * 3
    np.testing.assert_allclose(joints.command[:, 0], [0, 0.006, 0.006, 0.006, 0.006, 0.01, 0.01, 0.01])
    assert joints.command[:, -1].tolist() == [0] + [MODE_SERVO] * 7
    assert joints.is_complete(0, 3)
    assert not joints.is_complete(1, 5)
    assert not joints.is_complete(-1, 2)
    assert not joints.is_complete(6, 9)


def test_a_recording_at_another_rate_is_refused(tmp_path: Path) -> None:
    write_recording(tmp_path / "walk.mcap", [0, 5, 10], answered=[0])
    with pytest.raises(
        ValueError,
        match=r"walk\.mcap: low_state: found a period of 0\.005 s, expected 0\.001 s",
    ):
        read_joints(tmp_path / "walk.mcap")


def test_on_the_recorded_motion_the_true_model_leaves_the_noise(
    run: tuple[JointRecord, Callable[[float], Truth]],
) -> None:
    joints, _ = run
    true, ideal = ActuatorParameters.of(ALIENGO), ActuatorParameters.ideal(ALIENGO)
    assert torque_error(true, joints, 0.2, SECONDS) == pytest.approx(true.torque_noise, rel=0.05)
    assert torque_error(ideal, joints, 0.2, SECONDS) > 2 * true.torque_noise


def test_noise_of_encoders_on_which_the_drives_did_not_act_hardly_counts(
    run: tuple[JointRecord, Callable[[float], Truth]],
) -> None:
    joints, _ = run
    true, rng = ActuatorParameters.of(ALIENGO), np.random.default_rng(0)
    noisy = attrs.evolve(joints, dq=joints.dq + rng.normal(0.0, 0.3, joints.dq.shape))
    through = (ALIENGO.kd * 0.3) ** 2
    assert through > 0.3 * true.torque_noise
    assert torque_error(true, noisy, 0.2, SECONDS) < true.torque_noise + 0.3 * through


def test_in_open_loop_the_true_model_stays_closer_than_an_ideal_one(
    run: tuple[JointRecord, Callable[[float], Truth]],
) -> None:
    joints, truth = run
    true = open_loop_error(ALIENGO, ActuatorParameters.of(ALIENGO), joints, truth, 0.2, SECONDS)
    ideal = open_loop_error(ALIENGO, ActuatorParameters.ideal(ALIENGO), joints, truth, 0.2, SECONDS)
    assert true.stretches == ideal.stretches == 4
    assert true.q < 0.003
    assert true.dq < 0.7 * ideal.dq  # the noise of the torque alone makes half of it
    assert true.q < 0.2 * ideal.q
    assert len(ideal.growth) == 20
    assert ideal.growth[0] < 0.3 * ideal.q < 0.3 * ideal.growth[-1]
    assert np.sqrt(np.mean(np.square(ideal.growth))) == pytest.approx(ideal.q)


def test_a_stretch_without_history_is_not_replayed(run: tuple[JointRecord, Callable[[float], Truth]]) -> None:
    with pytest.raises(ValueError, match=r"nothing to replay between 0\.00 and 0\.25 s"):
        open_loop_error(ALIENGO, ActuatorParameters.of(ALIENGO), *run, 0.0, 0.25)


def test_the_gap_is_the_mean_distance_of_the_mean_velocities() -> None:
    command = np.zeros(3)
    plant = [Segment(command, np.array([0.5, 0.0, 0.1])), Segment(command, np.array([0.0, 0.2, 0.0]))]
    model = [Segment(command, np.array([0.53, 0.04, 0.0])), Segment(command, np.array([0.0, 0.2, 0.3]))]
    assert tracking_gap(plant, model) == pytest.approx((0.025, 0.2))
