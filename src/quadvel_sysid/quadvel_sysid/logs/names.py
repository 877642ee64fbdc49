"""Which columns of a file hold which field, by the field's own name or by the names that other tools use.

A name is taken as it is written (`q`, `q/FR_hip`), then as an alias, then by its words: case, separators, a leading
`joint_` and the order of field and joint do not matter (`Joint_Position_0`, `knee.pos`, `/joint_states/knee/position`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import product

FIELDS = (
    "t", "q", "dq", "tau", "q_des", "t_cmd", "q_des_cmd", "dq_des", "tau_ff", "kp", "kd", "temperature", "voltage", "valid",
)  # fmt: skip
NAMES = "joint_names"
TIMES = ("t", "t_cmd")
WHOLE = ""
"""In place of a joint: the column holds all joints, or a quantity that is no joint's."""
ALIASES = {
    "t": ("time", "timestamp"),
    "q": ("dof_pos", "position", "positions", "observation.state"),
    "dq": ("dof_vel", "velocity", "velocities", "speed", "observation.velocity"),
    "tau": ("effort", "torque", "torques", "observation.effort"),
    "q_des": ("des_dof_pos", "goal_position"),
}
"""What PACE, the message JointState, SAGE, BAM and LeRobot call them; taken where a field is not there by its own name."""
LEROBOT_TARGET = "action"
"""The commanded angles of a LeRobot data set; elsewhere an action need not be an angle."""

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
    """Field by the words that spell it."""
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
        (_TORQUE, "tau", ""),
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


def _spelled(name: str) -> tuple[str, str] | None:
    """Field and joint of a name by its words, or None."""
    found = [] if ".." in name else list(_WORD.finditer(name))
    words = [word[0].lower() for word in found]
    first = next((k for k, word in enumerate(words) if word not in _LEADING), len(words))
    for length in range(min(4, len(words)), 0, -1):
        for start in (first, 0):
            field = _spellings().get(tuple(words[start : start + length]))
            if field and len(words[start : start + length]) == length:
                rest = name[found[start + length].start() :] if start + length < len(words) else WHOLE
                return field, rest.rstrip("/._ []()")
        field = _spellings().get(tuple(words[-length:]))
        if field:
            return field, name[: found[-length].start()].strip("/._ []()").rpartition("/")[2]
    return None


def _as_written(names: Sequence[str], column: str) -> dict[str, str]:
    """Column by joint, of a field that is called `column`."""
    if column in names:
        return {WHOLE: column}
    return {name.partition("/")[2]: name for name in names if name.startswith(f"{column}/")}


def _by_words(names: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """Field, joint and name of those whose words say so; of several that say the same none."""
    said: dict[tuple[str, str], list[str]] = {}
    for name in names:
        field, joint = _spelled(name) or ("", "")
        if field and not (joint and field in (*TIMES, "voltage")):
            said.setdefault((field, joint), []).append(name)
    for (field, joint), those in said.items():
        if len(those) == 1:
            yield field, joint, those[0]


def resolve(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """For each field that is there, its column by joint; WHOLE is the only joint of a column for all of them.

    Args:
        names: all names in the file, in its order.
    """
    names = list(dict.fromkeys(names))
    worded: dict[str, dict[str, str]] = {}
    for field, joint, name in _by_words(names):
        worded.setdefault(field, {})[joint] = name
    found = {field: _written(names, field) or _whole(worded.get(field, {})) for field in FIELDS}
    joints = _joints(found, worded)
    for field in FIELDS:
        if not found[field]:
            found[field] = {joint: name for joint, name in worded.get(field, {}).items() if joint in joints}
    return {field: columns for field, columns in found.items() if columns}


def _written(names: Sequence[str], field: str) -> dict[str, str]:
    """Of a field that is called by its own name or by an alias."""
    aliases = ALIASES.get(field, ())
    if field == "q_des" and _as_written(names, "observation.state"):
        aliases = (*aliases, LEROBOT_TARGET)
    return next((found for one in (field, *aliases) if (found := _as_written(names, one))), {})


def _whole(columns: Mapping[str, str]) -> dict[str, str]:
    return {WHOLE: columns[WHOLE]} if WHOLE in columns else {}


def _joints(found: Mapping[str, Mapping[str, str]], worded: Mapping[str, Mapping[str, str]]) -> set[str]:
    """The joints that words may name: those of the angles, and of the commands if these name some."""
    angles, commands = (set(found[field] or worded.get(field, {})) for field in ("q", "q_des"))
    return (angles & commands or angles) - {WHOLE}
