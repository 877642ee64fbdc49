"""Joint states and joint commands from recordings of three message families.

The families are LowState and LowCmd of `quadvel_msgs`, LowState and LowCmd of `unitree_go`, and two
topics of `sensor_msgs/JointState`. Topics are found by their types; if several topics match, their
names decide.
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
from .stamps import missing_stamp_notices, stamp_of

Array = NDArray[Any]  # of floats
Names = tuple[str, ...]

LEG_JOINTS = tuple(
    f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")
)
"""The joints of LowState and LowCmd, Unitree's and quadvel's, in order."""
STATE_FIELDS = ("q", "dq", "tau")
COMMAND_FIELDS = ("q", "dq", "tau", "kp", "kd")
OWN_SERVO, UNITREE_SERVO = 10, 1
"""Modes in which a drive tracks position with gains."""
NO_TARGET_THRESHOLD = 1e4
"""Smallest value, rad or rad/s, that means "no target".

Unitree sends 2.146e9 rad and 16000 rad/s for it.
"""
COMMAND_TOPIC_PATTERN = re.compile(
    r"cmd|command|desired|target|reference|(^|[/_])(des|ref)($|[/_])|goal|setpoint|action", re.IGNORECASE
)
"""Pattern of the names of command topics."""
LOW_RATE_TOPIC_PATTERN = re.compile(r"(^|/)lf/")
"""Pattern of the topics on which Unitree repeats the states at a lower rate."""


def robot_of_types(typenames: Iterable[str]) -> str | None:
    """Return the robot that message types suggest, if a recording names none.

    Args:
        typenames: Type names of its topics.

    Returns:
        "go2" for types of `unitree_go`, else None.
    """
    return "go2" if any(name.startswith("unitree_go/") for name in typenames) else None


def _own_state(m: Any) -> tuple[Names, Array]:
    """Return joint names and q, dq, tau (3, 12) of a quadvel LowState."""
    return LEG_JOINTS, np.array([m.q, m.dq, m.tau])


def _own_command(m: Any) -> tuple[Names, Array]:
    """Return joint names and q, dq, tau, kp, kd (5, 12) of a quadvel LowCmd."""
    values = np.array([m.q, m.dq, m.tau, m.kp, m.kd])
    if m.mode != OWN_SERVO:  # a drive then ignores tau and kp, see LowCmd.msg
        values[2:4] = 0.0
    return LEG_JOINTS, values


def _unitree_state(m: Any) -> tuple[Names, Array]:
    """Return joint names and q, dq, tau (3, 12) of a Unitree LowState."""
    motors = m.motor_state[: len(LEG_JOINTS)]
    return LEG_JOINTS, np.array([[one.q, one.dq, one.tau_est] for one in motors], np.float32).T


def _unitree_command(m: Any) -> tuple[Names, Array]:
    """Return joint names and q, dq, tau, kp, kd (5, 12) of a Unitree LowCmd."""
    motors = m.motor_cmd[: len(LEG_JOINTS)]
    values = np.array([[one.q, one.dq, one.tau, one.kp, one.kd] for one in motors], np.float32).T
    values[2:, [one.mode != UNITREE_SERVO for one in motors]] = 0.0
    for target, gain in ((0, 3), (1, 4)):
        none = np.abs(values[target]) >= NO_TARGET_THRESHOLD
        values[target, none] = values[gain, none] = 0.0
    return LEG_JOINTS, values


def _joint_state(m: Any) -> tuple[Names, Array]:
    """Return joint names and q, dq, tau (3, J) of a JointState; NaN for an empty field."""
    values = np.full((len(STATE_FIELDS), len(m.name)), np.nan)
    for row, field in enumerate((m.position, m.velocity, m.effort)):
        if len(field) not in (0, len(m.name)):
            raise ValueError(f"found {len(field)} values for {len(m.name)} names, expected as many")
        values[row] = field if len(field) else np.nan
    return tuple(m.name), values


def _joint_command(m: Any) -> tuple[Names, Array]:
    """Return joint names and q, dq, tau, kp, kd (5, J) of a JointState; NaN for the gains."""
    names, values = _joint_state(m)
    return names, np.vstack([values, np.full((2, len(names)), np.nan)])


@attrs.frozen
class _MessageFamily:
    """The message types of states and commands, and their readers.

    Attributes:
        state: Type of the states.
        command: Type of the commands.
        read_state: Returns joint names and fields (3, J) of a state.
        read_command: Returns joint names and fields (5, J) of a command.
    """

    state: str
    command: str
    read_state: Callable[[Any], tuple[Names, Array]]
    read_command: Callable[[Any], tuple[Names, Array]]


JOINT_STATE = "sensor_msgs/msg/JointState"
FAMILIES = (
    _MessageFamily("quadvel_msgs/msg/LowState", "quadvel_msgs/msg/LowCmd", _own_state, _own_command),
    _MessageFamily("unitree_go/msg/LowState", "unitree_go/msg/LowCmd", _unitree_state, _unitree_command),
    _MessageFamily(JOINT_STATE, JOINT_STATE, _joint_state, _joint_command),
)


@attrs.frozen(eq=False)
class Series:
    """The joint values of one topic.

    Attributes:
        topic: The topic.
        joints: Names of the J joints.
        time: (n,), s since the first state.
        values: (n, J) for each recorded field: q (rad), dq (rad/s), tau (N m), kp (N m/rad), kd (N
            m s/rad).
    """

    topic: str
    joints: Names
    time: Array
    values: Mapping[str, Array]


@attrs.frozen(eq=False)
class JointLog:
    """Joint states and, if recorded, joint commands on one time base.

    Attributes:
        state: The states.
        command: The commands, or None.
        start_ns: Time of the first state, ns, by stamp or by receipt; the time base starts there.
        uses_receipt_times: Whether times are times of receipt, because stamps are missing.
    """

    state: Series
    command: Series | None
    start_ns: int
    uses_receipt_times: bool


class _Rows:
    """Stamps and times of receipt (ns) and values of one topic, packed as bytes to save memory."""

    def __init__(self) -> None:
        self.stamps: list[int | None] = []
        self.received: list[int] = []
        self.values = bytearray()
        self.dtype: Any = np.float32

    def add(self, stamp: int | None, received: int, values: Array) -> None:
        """Append one message.

        Args:
            stamp: Its stamp, ns, or None.
            received: Time of receipt, ns.
            values: (k, J), one row per field.
        """
        if not self.stamps:
            self.dtype = values.dtype
        self.stamps.append(stamp)
        self.received.append(received)
        self.values += values.astype(self.dtype, copy=False).tobytes()

    def series(self, topic: str, joints: Names, fields: Sequence[str], received: bool, begin: int) -> Series:
        """Return the rows as arrays without the fields that no message has.

        Args:
            topic: The topic.
            joints: Names of the J joints.
            fields: Names of the k fields.
            received: Use times of receipt instead of stamps.
            begin: Start of the time base, ns.

        Returns:
            The series of the topic.
        """
        rows = np.frombuffer(self.values, self.dtype).reshape(len(self.stamps), len(fields), len(joints))
        values = {field: rows[:, k] for k, field in enumerate(fields)}
        there = {field: each for field, each in values.items() if not np.isnan(each).all()}
        return Series(topic, joints, 1e-9 * (self.times(received) - begin), there)

    def times(self, received: bool) -> NDArray[np.int64]:
        """Return stamps or times of receipt.

        Args:
            received: Use times of receipt.

        Returns:
            Times (n,), ns.
        """
        return np.array(self.received if received else self.stamps, np.int64)


def read_joint_log(
    path: Path,
    state_topic: str | None = None,
    command_topic: str | None = None,
    notify: Callable[[str], None] | None = None,
    warn: Callable[[str], None] | None = None,
) -> JointLog:
    """Read joint states and, if there are any, joint commands from a recording.

    Args:
        path: A recording that `read_messages` can read.
        state_topic: Topic of the states; needed if several topics match.
        command_topic: Topic of the commands; needed if several topics match.
        notify: Receives a sentence for each assumption; by default such sentences become warnings.
        warn: Receives a sentence for missing stamps; by default `notify` receives it.

    Returns:
        The log on one time base.

    Raises:
        RecordingError: The recording holds no joint states, or several topics match. The sentence
            lists its topics.
    """
    there = topics(path)
    found = _select_topics(path, there, state_topic, command_topic)
    rows = _read_rows(path, there, found, notify)
    state, command = (_select_joints(path, topic, rows[topic], notify) if topic else None for topic in found)
    assert state is not None
    both = [one for one in (state, command) if one is not None]
    stamps = [one for _, _, one in both]
    sentences = missing_stamp_notices(
        {topic: one.times(False) for topic, _, one in both if None not in one.stamps}
    )
    for sentence in sentences:
        (warn or notify or (lambda _: None))(sentence)
    received = bool(sentences) or any(None in one.stamps for one in stamps)
    begin = int(state[2].times(received)[0])
    series = [
        one.series(topic, joints, fields, received, begin)
        for (topic, joints, one), fields in zip(both, (STATE_FIELDS, COMMAND_FIELDS), strict=False)
    ]
    return JointLog(series[0], series[1] if len(series) > 1 else None, begin, received)


def _read_rows(
    path: Path, there: Mapping[str, str], found: tuple[str, str | None], notify: Callable[[str], None] | None
) -> dict[str, dict[Names, _Rows]]:
    """Read the rows of each topic, separately for each list of joint names."""
    rows: dict[str, dict[Names, _Rows]] = {topic: defaultdict(_Rows) for topic in found if topic}
    readers = {}
    for topic, role in zip(found, ("state", "command"), strict=True):
        for family in FAMILIES:
            if topic and there[topic] == getattr(family, role):
                readers[topic] = getattr(family, f"read_{role}")
    for topic, received, message in read_messages(path, lambda topic, _: topic in readers, notify):
        try:
            names, values = readers[topic](message)
        except ValueError as error:
            raise RecordingError(f"{path}: {topic}: {error}") from None
        rows[topic][names].add(stamp_of(message), received, values)
    return rows


def _select_joints(
    path: Path, topic: str, rows: Mapping[Names, _Rows], notify: Callable[[str], None] | None
) -> tuple[str, Names, _Rows]:
    """Return the joint names that most messages of a topic have, with their rows."""
    if not rows:
        raise RecordingError(f"{path}: {topic}: no messages were recorded on it")
    joints = max(rows, key=lambda names: len(rows[names].stamps))
    others = sum(len(one.stamps) for names, one in rows.items() if names != joints)
    if others and notify:
        notify(f"{topic}: {others} messages name other joints than {joints[0]}, ... and are skipped")
    return topic, joints, rows[joints]


def _select_topics(
    path: Path, there: Mapping[str, str], state: str | None, command: str | None
) -> tuple[str, str | None]:
    """Return the topics of states and commands, or raise RecordingError."""
    for topic, role in ((state, "state"), (command, "command")):
        types = [getattr(family, role) for family in FAMILIES]
        if topic is not None and there.get(topic) not in types:
            found = there.get(topic, "no such topic")
            raise RecordingError(
                f"{path}: {topic}: found {found}, expected {' or '.join(types)}; {_describe_topics(there)}"
            )
    halves: tuple[str, str | None] | None = None
    for family in FAMILIES:
        states, commands = _candidates(there, family, state, command)
        for candidates, role in ((states, "state"), (commands, "command")):
            if len(candidates) > 1:
                listed = f"{', '.join(candidates)}: several topics of the type {getattr(family, role)}"
                raise RecordingError(f"{path}: {listed}; select one with --{role}-topic")
        if states and commands:
            return states[0], commands[0]
        if states and halves is None:
            halves = states[0], command
    if halves is None:
        expected = "expected states of joints: " + ", ".join(family.state for family in FAMILIES)
        raise RecordingError(f"{path}: {expected}; {_describe_topics(there)}")
    return halves


def _candidates(
    there: Mapping[str, str], family: _MessageFamily, state: str | None, command: str | None
) -> tuple[list[str], list[str]]:
    """Return the topics that match the states and the commands of a family."""
    states = [topic for topic, typename in there.items() if typename == family.state]
    commands = [topic for topic, typename in there.items() if typename == family.command]
    if family.state == family.command:
        states = [topic for topic in states if not COMMAND_TOPIC_PATTERN.search(topic) and topic != command]
        commands = [topic for topic in commands if COMMAND_TOPIC_PATTERN.search(topic) and topic != state]
    states = [topic for topic in states if not LOW_RATE_TOPIC_PATTERN.search(topic)] or states
    return [state] if state else states, [command] if command else commands


def _describe_topics(there: Mapping[str, str]) -> str:
    """List the topics of a recording for an error sentence."""
    listed = [f"{topic} ({typename})" for topic, typename in sorted(there.items())]
    more = f" and {len(listed) - 20} more" if len(listed) > 20 else ""
    return f"the recording has {', '.join(listed[:20]) or 'no topics'}{more}"


def require_commands(path: Path, log: JointLog) -> Series:
    """Return the commands of a log, or fail if there are none.

    Args:
        path: The recording, for the error sentence.
        log: What was read from it.

    Returns:
        The commands, with positions among their fields.

    Raises:
        RecordingError: The log has no commands, or the commands have no positions.
    """
    if log.command is None:
        types = ", ".join(dict.fromkeys(family.command for family in FAMILIES))
        expected = f"expected commands for the states on {log.state.topic}: a topic of {types}"
        raise RecordingError(
            f"{path}: {expected}; select one with --command-topic; {_describe_topics(topics(path))}"
        )
    if "q" not in log.command.values:
        raise RecordingError(
            f"{path}: {log.command.topic}: found no joint angles, expected commanded positions"
        )
    return log.command


def common_joints(joints: Iterable[str], others: Iterable[str]) -> list[str]:
    """Return the joints that both lists contain.

    Args:
        joints: Names of joints.
        others: Names of joints.

    Returns:
        The common names in the order of `joints`.
    """
    named = set(others)
    return [joint for joint in joints if joint in named]
