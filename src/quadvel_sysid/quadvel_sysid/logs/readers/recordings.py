"""Reader of recordings: of this stack, of a Unitree Go2, or with `sensor_msgs/JointState`.

Topics are found by their types, so namespaces and other topics do not matter. Rows have the
stamps of their messages, or the times of reception if the messages have none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Floats
from quadvel_recordings.joint_log import Series, common_joints, read_joint_log, require_commands
from quadvel_recordings.reading import RecordingError

from ..log import Log, LogError, joint_name
from .raw import check_size, storage_dtype
from .tables import drop_repeated_times


@attrs.frozen
class Topics:
    """Topics to read, for recordings in which several could hold the log.

    Attributes:
        state: Topic of the states, or None to find it by its type.
        command: Topic of the commands, or None to find it by its type and name.
    """

    state: str | None = None
    command: str | None = None


def read_recording(path: Path, topics: Topics) -> Log:
    """Read a log from a recording; rows of torque control and damping have kp = 0.

    Args:
        path: The recording.
        topics: Topics to read.

    Returns:
        The log.

    Raises:
        LogError: The recording is damaged, or holds no states or commands.
    """
    remarks: list[str] = []
    warnings: list[str] = []
    try:
        found = read_joint_log(path, topics.state, topics.command, remarks.append, warnings.append)
        state, command = found.state, require_commands(path, found)
    except RecordingError as error:
        raise LogError(str(error)) from None
    joints = _joints(path, state, command, remarks)
    if "q" not in state.values:
        raise LogError(f"{path}: {state.topic}: found no angles in it, expected positions")
    t, states = _select_joints(path, "t", state, joints, remarks)
    t_cmd, commands = _select_joints(path, "t_cmd", command, joints, remarks)
    derived = () if "dq" in states else ("dq",)
    if derived and (np.diff(t) > 0.0).all():
        states["dq"] = np.gradient(states["q"], t, axis=0)
    return Log(
        name=str(path),
        joints=tuple(joint_name(name) for name in joints),
        t=t,
        q=states["q"],
        dq=states.get("dq", states["q"]),
        tau=states.get("tau"),
        valid=np.ones(states["q"].shape, bool),
        t_cmd=t_cmd,
        q_des=commands["q"],
        dq_des=_none_if_zero(commands.get("dq")),
        tau_ff=_none_if_zero(commands.get("tau")),
        kp=commands.get("kp"),
        kd=commands.get("kd"),
        remarks=tuple(remarks),
        warnings=tuple(warnings),
        derived=derived,
    )


def _joints(path: Path, state: Series, command: Series, remarks: list[str]) -> list[str]:
    """Joints that both states and commands name."""
    joints = common_joints(state.joints, command.joints)
    if not joints:
        found = f"found {', '.join(command.joints[:3])}, ..."
        raise LogError(
            f"{path}: {command.topic}: {found}, expected joints of {state.topic}: {', '.join(state.joints[:3])}, ..."
        )
    left = [name for name in (*state.joints, *command.joints) if name not in joints]
    if left:
        remarks.append(f"joint_names: {', '.join(left)}: not both measured and commanded; left out")
    return joints


def _select_joints(
    path: Path, field: str, series: Series, joints: list[str], remarks: list[str]
) -> tuple[Floats, dict[str, Any]]:
    """Times and values of these joints, without rows that repeat a time."""
    columns = [series.joints.index(name) for name in joints]
    check_size(path, {name: values.shape for name, values in series.values.items()})
    dtype = storage_dtype(sum(values.size for values in series.values.values()))
    values = {name: each[:, columns].astype(dtype, copy=False) for name, each in series.values.items()}
    return drop_repeated_times(field, series.time, values, remarks)


def _none_if_zero(values: Floats | None) -> Floats | None:
    """None if all values are 0."""
    return values if values is not None and values.any() else None
