"""Reads a recording into a `Run`: own topics, another stack's topics, or a table of joints.

`run` defines the result, and `quadvel_recordings` decodes the files.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadvel_description.arrays import Array, Floats, Indices
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot, robot_of_file
from quadvel_description.robot_name import described_robot
from quadvel_description.state import MODE_DAMPING
from quadvel_eval.recording import Series, planar
from quadvel_nodes.messages import seconds
from quadvel_recordings.reading import (
    RecordingError,
    read_messages,
    recorded_description,
    topics,
    warn_of_unused_gains,
)
from quadvel_sysid.logs.log import Log
from quadvel_sysid.logs.read_log import read_log
from quadvel_sysid.logs.readers.columns import ColumnMap
from quadvel_sysid.logs.readers.recordings import Topics

from .run import Commands, Imu, Modes, Run

TICK_S = 1e-3
"""Unit of the robot's counter."""
MIN_STATES = 20
"""Fewest states of a recording that can be examined."""
STATE, COMMAND = "quadvel_msgs/msg/LowState", "quadvel_msgs/msg/LowCmd"
OTHERS_STATE = "unitree_go/msg/LowState"
OTHER_TYPES = {
    "estimate": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "velocity_command": "quadvel_msgs/msg/VelocityCommand",
    "controller": "quadvel_msgs/msg/ControllerState",
    "motors": "quadvel_msgs/msg/MotorStatus",
}
RECORDINGS = (".mcap", ".db3", ".bag")
Messages = Mapping[str, Sequence[Any]]
"""Messages by name of their topic's role."""


def read_run(
    path: Path,
    gains: tuple[float, float] | None = None,
    robot: str | None = None,
    names: ColumnMap | None = None,
    topics_of_log: Topics | None = None,
) -> Run:
    """Read a recording.

    Args:
        path: A recording (MCAP, rosbag2, ROS 1), or a table that `quadvel identify` reads.
        gains: kp (N m/rad) and kd (N m s/rad) of the commands, if the file holds none.
        robot: Name or file of the robot; None for the one that the recording names.
        names: Names of the fields in a table; None for those of `quadvel identify`.
        topics_of_log: Topics of another stack's recording that hold states and commands; None: found by type.

    Returns:
        The run.

    Raises:
        RecordingError: The file holds too little for a diagnosis.
        LogError: A table cannot be used.
        ValueError: The recording is that of another robot.
    """
    is_recording = path.suffix in RECORDINGS or path.is_dir()
    types = topics(path) if is_recording else {}
    if STATE in types.values():
        if topics_of_log is not None and topics_of_log != Topics():
            raise RecordingError(
                f"{path}: holds the topics of this stack, expected no --state-topic and no --command-topic"
            )
        if gains is not None:
            warn_of_unused_gains(path)
        named = described_robot(recorded_description(path))
        return _own_run(path, robot_of_file(path, named, robot), types)
    log = read_log(path, names=names, topics=topics_of_log, robot=robot)
    if gains is None and (log.kp is None or log.kd is None):
        raise RecordingError(f"{path}: kp, kd: the commands hold no gains, expected --gains KP KD")
    if log.holds_other_gains(gains):
        warn_of_unused_gains(path)
    return _run_of_log(log.with_gains(gains), _others_imu(path, types, log))


def _own_run(path: Path, robot: Robot, types: Mapping[str, str]) -> Run:
    """Run from the topics of this stack; they are found by their types."""
    roles = {STATE: "states", COMMAND: "commands"} | {kind: role for role, kind in OTHER_TYPES.items()}
    remarks: list[str] = []
    found: dict[str, list[Any]] = defaultdict(list)
    for topic, _, message in read_messages(path, lambda _, kind: kind in roles, remarks.append):
        found[roles[types[topic]]].append(message)
    states, commands = found["states"], found["commands"]
    if len(states) < MIN_STATES or not commands:
        raise RecordingError(
            f"{path}: low_state, low_cmd: found {len(states)} states and {len(commands)} commands, "
            f"expected {MIN_STATES} states and their commands"
        )
    stamps = np.array([seconds(m.stamp) for m in states])
    order = np.argsort(stamps, kind="stable")
    states, start = [states[i] for i in order], float(stamps.min())
    return Run(
        name=str(path),
        robot=robot,
        joints=JOINT_NAMES,
        time=stamps[order] - start,
        q=_rows(states, "q"),
        dq=_rows(states, "dq"),
        tau=_rows(states, "tau"),
        imu=Imu(*(_rows(states, f) for f in ("orientation_wxyz", "angular_velocity", "linear_acceleration"))),
        commands=_own_commands(commands, states, start),
        is_own=True,
        remarks=tuple(remarks),
        **_other_series(found, start),
    )


def _rows(messages: Sequence[Any], field: str) -> Array:
    return np.array([getattr(m, field) for m in messages], float)


def _own_commands(messages: Sequence[Any], states: Sequence[Any], start: float) -> Commands:
    """Return the commands in the order of their stamps, each with the state that it answers.

    If that state was not recorded, it is the recorded state before it.
    """
    messages = sorted(messages, key=lambda m: seconds(m.stamp))
    ticks = np.array([m.tick for m in states])
    answers = np.searchsorted(ticks, [m.tick for m in messages], side="right") - 1
    answers = np.maximum(answers, 0)
    fields = {field: _rows(messages, field) for field in ("q", "dq", "tau", "kp", "kd")}
    stamps, state_stamps = (np.array([seconds(m.stamp) for m in each]) for each in (messages, states))
    # A simulated clock does not advance between states. All stamps of commands are then equal to
    # those of states, and a command gets the stamp of the state that it answers.
    if np.isin(_microseconds(stamps), _microseconds(state_stamps)).all():
        stamps = state_stamps[answers]
    return Commands(
        time=stamps - start,
        answers=answers,
        servo=np.array([m.mode != MODE_DAMPING for m in messages]),
        **fields,
    )


def _microseconds(stamps: Array) -> Indices:
    return np.round(1e6 * stamps).astype(np.int64)


def _other_series(found: Messages, start: float) -> dict[str, Any]:
    """Return the slower topics that were recorded."""
    given: dict[str, Any] = {}
    if found["estimate"]:
        given["estimate"] = _series(
            found["estimate"], start, lambda m: _xyz(m.twist.twist.linear), lambda m: m.header.stamp
        )
    if found["velocity_command"]:
        given["velocity_command"] = _series(
            found["velocity_command"], start, lambda m: [*planar(m.twist), float(m.stance)]
        )
    if reports := found["controller"]:
        given["effective_command"] = _series(reports, start, lambda m: [*planar(m.command), float(m.stance)])
        if hasattr(reports[0], "trim"):  # older recordings lack it: their controller had no trim
            given["trim"] = _series(reports, start, lambda m: planar(m.trim))
        time = np.array([seconds(m.stamp) - start for m in reports])
        given["modes"] = Modes(time, tuple(m.mode_name for m in reports), tuple(m.fault for m in reports))
    if found["motors"]:
        given["temperature"] = _series(found["motors"], start, lambda m: m.temperature)
    return given


def _series(
    messages: Sequence[Any],
    start: float,
    value: Callable[[Any], Any],
    stamp: Callable[[Any], Any] = lambda message: message.stamp,
) -> Series:
    pairs = sorted(((seconds(stamp(m)) - start, value(m)) for m in messages), key=lambda pair: pair[0])
    return Series(np.array([time for time, _ in pairs]), np.array([each for _, each in pairs], float))


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def _others_imu(path: Path, types: Mapping[str, str], log: Log) -> Imu | None:
    """IMU of another robot's LowState, if there is one for each row of the log."""
    names = [topic for topic, kind in types.items() if kind == OTHERS_STATE]
    if len(names) != 1:
        return None
    found = [
        m.imu_state for _, _, m in read_messages(path, lambda topic, _: topic == names[0], lambda _: None)
    ]
    if len(found) != len(log.t):
        return None
    return Imu(*(_rows(found, field) for field in ("quaternion", "gyroscope", "accelerometer")))


def _run_of_log(log: Log, imu: Imu | None) -> Run:
    """Run of a joint log; the commands of a log hold position if their stiffness is above zero."""
    start = float(log.t[0])
    assert log.kp is not None
    assert log.kd is not None
    assert log.robot is not None
    none = np.zeros(log.q_des.shape)

    def floats(values: Floats | None) -> Array:
        return none if values is None else np.asarray(values, np.float64)

    commands = Commands(
        time=floats(log.t_cmd) - start,
        answers=np.maximum(np.searchsorted(log.t, log.t_cmd, side="right") - 1, 0),
        q=floats(log.q_des),
        dq=floats(log.dq_des),
        tau=floats(log.tau_ff),
        kp=floats(log.kp),
        kd=floats(log.kd),
        servo=np.asarray((log.kp > 0.0).any(axis=1)),
    )
    return Run(
        name=log.name,
        robot=log.robot,
        joints=log.joints,
        time=floats(log.t) - start,
        q=floats(log.q),
        dq=floats(log.dq),
        tau=None if log.tau is None else floats(log.tau),
        imu=imu,
        commands=commands,
        remarks=(*log.remarks, *log.warnings),
    )
