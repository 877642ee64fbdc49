"""States and commands of joints out of a recording, whichever of three kinds of messages they are.

`quadvel_msgs` LowState and LowCmd, `unitree_go` LowState and LowCmd, or two topics of `sensor_msgs/JointState`. They are found by
their types; the names of topics decide where several could be meant.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from .reading import RecordingError, read_messages, topics
from .stamps import stamp_of, unstamped

Array = NDArray[Any]  # of floats
Names = tuple[str, ...]

LEG_JOINTS = tuple(
    f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")
)
"""The joints of LowState and LowCmd, Unitree's and ours, in their order."""
STATE_FIELDS = ("q", "dq", "tau")
COMMAND_FIELDS = ("q", "dq", "tau", "kp", "kd")
OWN_SERVO, UNITREE_SERVO = 10, 1
"""Modes in which a drive obeys position and gains."""
NO_TARGET = 1e4
"""Unitree sends an angle of 2.146e9 rad and a speed of 16000 rad/s for "none"."""
COMMANDS = re.compile(
    r"cmd|command|desired|target|reference|(^|[/_])(des|ref)($|[/_])|goal|setpoint|action", re.IGNORECASE
)
"""How topics of commands are called."""
SLOW = re.compile(r"(^|/)lf/")
"""Where Unitree publishes the same states once more, less often."""


def _own_state(m: Any) -> tuple[Names, Array]:
    return LEG_JOINTS, np.array([m.q, m.dq, m.tau])


def _own_command(m: Any) -> tuple[Names, Array]:
    values = np.array([m.q, m.dq, m.tau, m.kp, m.kd])
    if m.mode != OWN_SERVO:  # kp and tau are ignored, see LowCmd.msg
        values[2:4] = 0.0
    return LEG_JOINTS, values


def _unitree_state(m: Any) -> tuple[Names, Array]:
    motors = m.motor_state[: len(LEG_JOINTS)]
    return LEG_JOINTS, np.array([[one.q, one.dq, one.tau_est] for one in motors], np.float32).T


def _unitree_command(m: Any) -> tuple[Names, Array]:
    motors = m.motor_cmd[: len(LEG_JOINTS)]
    values = np.array([[one.q, one.dq, one.tau, one.kp, one.kd] for one in motors], np.float32).T
    values[2:, [one.mode != UNITREE_SERVO for one in motors]] = 0.0
    for target, gain in ((0, 3), (1, 4)):
        none = np.abs(values[target]) >= NO_TARGET
        values[target, none] = values[gain, none] = 0.0
    return LEG_JOINTS, values


def _joint_state(m: Any) -> tuple[Names, Array]:
    values = np.full((len(STATE_FIELDS), len(m.name)), np.nan)
    for row, field in enumerate((m.position, m.velocity, m.effort)):
        if len(field) not in (0, len(m.name)):
            raise ValueError(f"found {len(field)} values for {len(m.name)} names, expected as many")
        values[row] = field if len(field) else np.nan
    return tuple(m.name), values


def _joint_command(m: Any) -> tuple[Names, Array]:
    names, values = _joint_state(m)
    return names, np.vstack([values, np.full((2, len(names)), np.nan)])


@attrs.frozen
class _Family:
    """Two types of messages that belong together, and what reads them: names of joints, fields (k, J)."""

    state: str
    command: str
    read_state: Callable[[Any], tuple[Names, Array]]
    read_command: Callable[[Any], tuple[Names, Array]]


JOINT_STATE = "sensor_msgs/msg/JointState"
FAMILIES = (
    _Family("quadvel_msgs/msg/LowState", "quadvel_msgs/msg/LowCmd", _own_state, _own_command),
    _Family("unitree_go/msg/LowState", "unitree_go/msg/LowCmd", _unitree_state, _unitree_command),
    _Family(JOINT_STATE, JOINT_STATE, _joint_state, _joint_command),
)


@attrs.frozen(eq=False)
class Series:
    """What one topic holds of J joints: times (n,), s, and values (n, J) of each field that is there."""

    topic: str
    joints: Names
    time: Array
    values: Mapping[str, Array]


@attrs.frozen(eq=False)
class JointLog:
    """States and, where there are any, commands, on one time base that begins with the first state.

    begin: ns, that instant on the clock that counts. received: times of receipt count, as stamps are missing.
    """

    state: Series
    command: Series | None
    begin: int
    received: bool


class _Rows:
    """Stamps and times of receipt (ns) and the values of one topic, kept as bytes while they come: a log is long."""

    def __init__(self) -> None:
        self.stamps: list[int | None] = []
        self.received: list[int] = []
        self.values = bytearray()
        self.dtype: Any = np.float32

    def add(self, stamp: int | None, received: int, values: Array) -> None:
        if not self.stamps:
            self.dtype = values.dtype
        self.stamps.append(stamp)
        self.received.append(received)
        self.values += values.astype(self.dtype, copy=False).tobytes()

    def series(self, topic: str, joints: Names, fields: Sequence[str], received: bool, begin: int) -> Series:
        """The rows as arrays; a field that no message has is left out."""
        rows = np.frombuffer(self.values, self.dtype).reshape(len(self.stamps), len(fields), len(joints))
        values = {field: rows[:, k] for k, field in enumerate(fields)}
        there = {field: each for field, each in values.items() if not np.isnan(each).all()}
        return Series(topic, joints, 1e-9 * (self.times(received) - begin), there)

    def times(self, received: bool) -> NDArray[np.int64]:
        return np.array(self.received if received else self.stamps, np.int64)


def read_joint_log(
    path: Path,
    state_topic: str | None = None,
    command_topic: str | None = None,
    tell: Callable[[str], None] | None = None,
    warn: Callable[[str], None] | None = None,
) -> JointLog:
    """The states of joints in a recording, and the commands if there are any.

    Args:
        path: a recording as `read_messages` reads it.
        state_topic: topic of the states, where several could be meant.
        command_topic: topic of the commands, likewise.
        tell: called with a sentence for what had to be assumed; without it such sentences become warnings.
        warn: called with a sentence for stamps that are missing; without it these go to `tell`.

    Raises:
        RecordingError: no states, or several topics that could hold them; the sentence names the topics that are there.
    """
    there = topics(path)
    found = _pair(path, there, state_topic, command_topic)
    rows = _rows(path, there, found, tell)
    state, command = (_most(path, topic, rows[topic], tell) if topic else None for topic in found)
    assert state is not None
    both = [one for one in (state, command) if one is not None]
    stamps = [one for _, _, one in both]
    sentences = unstamped({topic: one.times(False) for topic, _, one in both if None not in one.stamps})
    for sentence in sentences:
        (warn or tell or (lambda _: None))(sentence)
    received = bool(sentences) or any(None in one.stamps for one in stamps)
    begin = int(state[2].times(received)[0])
    series = [
        one.series(topic, joints, fields, received, begin)
        for (topic, joints, one), fields in zip(both, (STATE_FIELDS, COMMAND_FIELDS), strict=False)
    ]
    return JointLog(series[0], series[1] if len(series) > 1 else None, begin, received)


def _rows(
    path: Path, there: Mapping[str, str], found: tuple[str, str | None], tell: Callable[[str], None] | None
) -> dict[str, dict[Names, _Rows]]:
    """By topic, the rows of each list of joints that its messages name."""
    rows: dict[str, dict[Names, _Rows]] = {topic: defaultdict(_Rows) for topic in found if topic}
    readers = {}
    for topic, role in zip(found, ("state", "command"), strict=True):
        for family in FAMILIES:
            if topic and there[topic] == getattr(family, role):
                readers[topic] = getattr(family, f"read_{role}")
    for topic, received, message in read_messages(path, lambda topic, _: topic in readers, tell):
        try:
            names, values = readers[topic](message)
        except ValueError as error:
            raise RecordingError(f"{path}: {topic}: {error}") from None
        rows[topic][names].add(stamp_of(message), received, values)
    return rows


def _most(
    path: Path, topic: str, rows: Mapping[Names, _Rows], tell: Callable[[str], None] | None
) -> tuple[str, Names, _Rows]:
    """The joints that most messages of a topic name, with their rows."""
    if not rows:
        raise RecordingError(f"{path}: {topic}: no messages were recorded on it")
    joints = max(rows, key=lambda names: len(rows[names].stamps))
    others = sum(len(one.stamps) for names, one in rows.items() if names != joints)
    if others and tell:
        tell(f"{topic}: {others} messages name other joints than {joints[0]}, ... and are left out")
    return topic, joints, rows[joints]


def _pair(
    path: Path, there: Mapping[str, str], state: str | None, command: str | None
) -> tuple[str, str | None]:
    """The topics of states and commands. Raises RecordingError."""
    for topic, role in ((state, "state"), (command, "command")):
        types = [getattr(family, role) for family in FAMILIES]
        if topic is not None and there.get(topic) not in types:
            found = there.get(topic, "no such topic")
            raise RecordingError(
                f"{path}: {topic}: found {found}, expected {' or '.join(types)}; {_listed(there)}"
            )
    halves: tuple[str, str | None] | None = None
    for family in FAMILIES:
        states, commands = _candidates(there, family, state, command)
        for candidates, role in ((states, "state"), (commands, "command")):
            if len(candidates) > 1:
                listed = f"{', '.join(candidates)}: several topics of the type {getattr(family, role)}"
                raise RecordingError(f"{path}: {listed}; --{role}-topic says which")
        if states and commands:
            return states[0], commands[0]
        if states and halves is None:
            halves = states[0], command
    if halves is None:
        expected = "expected states of joints: " + ", ".join(family.state for family in FAMILIES)
        raise RecordingError(f"{path}: {expected}; {_listed(there)}")
    return halves


def _candidates(
    there: Mapping[str, str], family: _Family, state: str | None, command: str | None
) -> tuple[list[str], list[str]]:
    """Topics that may hold a family's states and commands."""
    states = [topic for topic, typename in there.items() if typename == family.state]
    commands = [topic for topic, typename in there.items() if typename == family.command]
    if family.state == family.command:
        states = [topic for topic in states if not COMMANDS.search(topic) and topic != command]
        commands = [topic for topic in commands if COMMANDS.search(topic) and topic != state]
    states = [topic for topic in states if not SLOW.search(topic)] or states
    return [state] if state else states, [command] if command else commands


def _listed(there: Mapping[str, str]) -> str:
    """The topics of a recording in words."""
    listed = [f"{topic} ({typename})" for topic, typename in sorted(there.items())]
    more = f" and {len(listed) - 20} more" if len(listed) > 20 else ""
    return f"the recording has {', '.join(listed[:20]) or 'no topics'}{more}"


def expect_commands(path: Path, log: JointLog) -> Series:
    """The commands of a recording that has to have some. Raises RecordingError."""
    if log.command is None:
        types = ", ".join(dict.fromkeys(family.command for family in FAMILIES))
        expected = f"expected commands beside the states on {log.state.topic}: a topic of {types}"
        raise RecordingError(f"{path}: {expected}; --command-topic says which; {_listed(topics(path))}")
    if "q" not in log.command.values:
        raise RecordingError(
            f"{path}: {log.command.topic}: found no angles in it, expected commanded positions"
        )
    return log.command


def shared(joints: Iterable[str], others: Iterable[str]) -> list[str]:
    """The joints that both name, in the first one's order."""
    named = set(others)
    return [joint for joint in joints if joint in named]
