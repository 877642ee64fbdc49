"""Logs out of recordings of the stack: low_state and low_cmd of quadvel_msgs, as `quadvel record` writes them.

Found by their types, so namespaces and other topics of the recording do not matter. Rows are stamped as their
messages are, not as they arrived.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from quadvel_description.robot import JOINT_NAMES
from quadvel_description.state import MODE_SERVO
from quadvel_recordings.reading import RecordingError, read_messages

from .log import Array, Log, LogError
from .raw import precision
from .tables import drop_repeated_times

STATE, COMMAND = "quadvel_msgs/msg/LowState", "quadvel_msgs/msg/LowCmd"
STATE_FIELDS = ("q", "dq", "tau")
COMMAND_FIELDS = ("q", "dq", "tau", "kp", "kd")


class _Rows:
    """Stamps (ns) and values of one topic, kept as bytes while they come: a log is long."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._values = bytearray()

    def add(self, message: Any, fields: tuple[str, ...]) -> None:
        self._stamps.append(message.stamp.sec * 10**9 + message.stamp.nanosec)
        row = np.concatenate([getattr(message, field) for field in fields], dtype=np.float32)
        if getattr(message, "mode", MODE_SERVO) != MODE_SERVO:  # kp and tau are ignored, see LowCmd.msg
            row[2 * len(JOINT_NAMES) : 4 * len(JOINT_NAMES)] = 0.0
        self._values += row.tobytes()

    def arrays(self, fields: tuple[str, ...], start: int) -> tuple[Array, dict[str, Array]]:
        """Times since `start` (ns), s, and the values (n, 12) of each field."""
        values = np.frombuffer(self._values, np.float32).reshape(len(self._stamps), len(fields), -1)
        values = values.astype(precision(values.size), copy=False)
        time = (np.array(self._stamps, np.int64) - start) * 1e-9
        return time, {field: values[:, k] for k, field in enumerate(fields)}

    @property
    def first(self) -> int:
        return self._stamps[0]


def read(path: Path) -> Log:
    """The recording as a log; torque control and damping stand in it as kp = 0. Raises LogError."""
    rows: dict[str, _Rows] = defaultdict(_Rows)
    topics: dict[str, str] = {}
    types: dict[str, str] = {}
    remarks: list[str] = []

    def wanted(topic: str, typename: str) -> bool:
        if typename in (STATE, COMMAND):
            types[topic] = typename
        return topic in types

    try:
        for topic, _, message in read_messages(path, wanted, remarks.append):
            kind = types[topic]
            if topics.setdefault(kind, topic) != topic:
                raise LogError(f"{path}: {kind}: found on {topics[kind]} and on {topic}, expected one topic")
            rows[kind].add(message, STATE_FIELDS if kind == STATE else COMMAND_FIELDS)
    except RecordingError as error:
        raise LogError(str(error)) from None
    for kind, topic in ((STATE, "low_state"), (COMMAND, "low_cmd")):
        if kind not in rows:
            raise LogError(f"{path}: {topic}: no messages of the type {kind} were recorded")

    start = rows[STATE].first
    t, state = rows[STATE].arrays(STATE_FIELDS, start)
    t_cmd, command = rows[COMMAND].arrays(COMMAND_FIELDS, start)
    t, state = drop_repeated_times("t", t, state, remarks)
    t_cmd, command = drop_repeated_times("t_cmd", t_cmd, command, remarks)
    return Log(
        name=str(path),
        joints=JOINT_NAMES,
        t=t,
        q=state["q"],
        dq=state["dq"],
        tau=state["tau"],
        valid=np.ones(state["q"].shape, bool),
        t_cmd=t_cmd,
        q_des=command["q"],
        dq_des=_unless_zero(command["dq"]),
        tau_ff=_unless_zero(command["tau"]),
        kp=command["kp"],
        kd=command["kd"],
        remarks=tuple(remarks),
    )


def _unless_zero(values: Array) -> Array | None:
    return values if values.any() else None
