"""Match the column names of a file to the fields of a log.

A name matches as it is written (`q`, `q/FR_hip`), then as an alias, then by its words. In the
last case the letter case, separators, a leading `joint_` and the order of field and joint do not
matter (`Joint_Position_0`, `knee.pos`, `/joint_states/knee/position`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import product

FIELDS = (
    "t", "q", "dq", "tau", "q_des", "t_cmd", "q_des_cmd", "dq_des", "tau_ff", "kp", "kd", "temperature", "voltage", "valid",
)  # fmt: skip
"""Fields of a log in a file."""
JOINT_NAMES_FIELD = "joint_names"
"""Array with the names of the joints."""
TIME_FIELDS = ("t", "t_cmd")
"""Fields that hold times."""
ALL_JOINTS = ""
"""Key instead of the name of a joint, for a column of all joints or of a quantity without joints."""
ALIASES = {
    "t": ("time", "timestamp"),
    "q": ("dof_pos", "position", "positions", "observation.state"),
    "dq": ("dof_vel", "velocity", "velocities", "speed", "observation.velocity"),
    "tau": ("effort", "torque", "torques", "observation.effort"),
    "q_des": ("des_dof_pos", "goal_position"),
}
"""Names that PACE, the message JointState, SAGE, BAM and LeRobot use, if the field's own name is
absent.
"""
LEROBOT_TARGET = "action"
"""The commanded angles of a LeRobot data set; in other files an action need not be an angle."""

_ANGLE = (("q",), ("pos",), ("position",), ("positions",), ("angle",), ("angles",), ("qpos",), ("dof", "pos"))
_SPEED = (
    ("dq",),
    ("vel",),
    ("velocity",),
    ("velocities",),
    ("speed",),
    ("qvel",),
    ("qdot",),
    ("q", "dot"),
    ("dof", "vel"),
)
_TORQUE = (("tau",), ("torque",), ("torques",), ("effort",), ("efforts",))
_MEASURED = ("meas", "measured", "act", "actual", "est", "fb", "feedback")
_COMMANDED = (
    "des",
    "desired",
    "cmd",
    "command",
    "commanded",
    "ref",
    "reference",
    "target",
    "goal",
    "setpoint",
)
_LEADING = ("joint", "joints", "motor", "motors", "field", "state", "states")
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+")


@cache
def _spellings() -> Mapping[tuple[str, ...], str]:
    """Field by the tuple of words that spells it."""
    words = {
        ("time",): "t",
        ("timestamp",): "t",
        ("stamp",): "t",
        ("header", "stamp"): "t",
        ("temp",): "temperature",
    }
    words |= {(name,): name for name in FIELDS if "_" not in name}
    words |= {tuple(name.split("_")): name for name in FIELDS} | {
        ("qdes",): "q_des",
        ("torque", "ff"): "tau_ff",
    }
    for bases, measured, commanded in (
        (_ANGLE, "q", "q_des"),
        (_SPEED, "dq", "dq_des"),
        (_TORQUE, "tau", ""),  # a commanded torque is no field of a log
    ):
        words |= dict.fromkeys(bases, measured)
        words |= {
            both: measured
            for base, more in product(bases, _MEASURED)
            for both in ((*base, more), (more, *base))
        }
        if commanded:
            pairs = product(bases, _COMMANDED)
            words |= {both: commanded for base, more in pairs for both in ((*base, more), (more, *base))}
    return words


def _match_words(name: str) -> tuple[str, str] | None:
    """Field and joint of a name by its words, or None.

    The longest spelling of a field at the start (without leading words such as "motor") or at the
    end of the name counts; the rest is the joint.
    """
    found = [] if ".." in name else list(_WORD.finditer(name))
    words = [word[0].lower() for word in found]
    first = next((k for k, word in enumerate(words) if word not in _LEADING), len(words))
    for length in range(min(4, len(words)), 0, -1):
        for start in (first, 0):
            field = _spellings().get(tuple(words[start : start + length]))
            if field and len(words[start : start + length]) == length:
                rest = name[found[start + length].start() :] if start + length < len(words) else ALL_JOINTS
                return field, rest.rstrip("/._ []()")
        field = _spellings().get(tuple(words[-length:]))
        if field:
            return field, name[: found[-length].start()].strip("/._ []()").rpartition("/")[2]
    return None


def _match_exactly(names: Sequence[str], column: str) -> dict[str, str]:
    """Column of each joint for a field called `column`."""
    if column in names:
        return {ALL_JOINTS: column}
    return {name.partition("/")[2]: name for name in names if name.startswith(f"{column}/")}


def _unambiguous_words(names: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """Yield field, joint and name of the names that match by words, without ambiguous ones."""
    matches: dict[tuple[str, str], list[str]] = {}
    for name in names:
        field, joint = _match_words(name) or ("", "")
        if field and not (joint and field in (*TIME_FIELDS, "voltage")):
            matches.setdefault((field, joint), []).append(name)
    for (field, joint), those in matches.items():
        if len(those) == 1:
            yield field, joint, those[0]


def resolve_columns(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Find the columns of each field.

    Args:
        names: All names in the file, in its order.

    Returns:
        For each field found: the column of each joint. `ALL_JOINTS` is the only key of a column
        that holds all joints.
    """
    names = list(dict.fromkeys(names))
    worded: dict[str, dict[str, str]] = {}
    for field, joint, name in _unambiguous_words(names):
        worded.setdefault(field, {})[joint] = name
    found = {field: _match_field(names, field) or _only_all_joints(worded.get(field, {})) for field in FIELDS}
    joints = _joints(found, worded)
    for field in FIELDS:
        if not found[field]:
            found[field] = {joint: name for joint, name in worded.get(field, {}).items() if joint in joints}
    return {field: columns for field, columns in found.items() if columns}


def _match_field(names: Sequence[str], field: str) -> dict[str, str]:
    """Columns of a field called by its own name or by an alias."""
    aliases = ALIASES.get(field, ())
    if field == "q_des" and _match_exactly(names, "observation.state"):
        aliases = (*aliases, LEROBOT_TARGET)
    return next((found for one in (field, *aliases) if (found := _match_exactly(names, one))), {})


def _only_all_joints(columns: Mapping[str, str]) -> dict[str, str]:
    """The column that holds all joints, if there is one."""
    return {ALL_JOINTS: columns[ALL_JOINTS]} if ALL_JOINTS in columns else {}


def _joints(found: Mapping[str, Mapping[str, str]], worded: Mapping[str, Mapping[str, str]]) -> set[str]:
    """Joints that words may match: those with angles and commands, or all with angles if none has both."""
    angles, commands = (set(found[field] or worded.get(field, {})) for field in ("q", "q_des"))
    return (angles & commands or angles) - {ALL_JOINTS}
