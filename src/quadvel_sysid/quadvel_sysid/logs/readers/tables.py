"""Make a log from named arrays: equal shapes, one time base for all commands.

`files.READERS` has a module for each file format; here their arrays become a `Log`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadvel_description.arrays import Bools, Floats
from quadvel_description.name_list import format_names
from quadvel_description.quadruped import JOINT_NAMES

from ..log import Log, LogError, joint_name
from .columns import UNUSED, ColumnMap, count_whole_rows, read_fields
from .raw import check_size

STATE_FIELDS = ("q", "dq", "tau", "temperature")
"""Fields on the times of the states."""
COMMAND_FIELDS = ("dq_des", "tau_ff", "kp", "kd")
"""Fields on the times of the commands, besides q_des."""

EXPECTED_COMMANDS = (
    "; expected q_des, or t_cmd and q_des_cmd, which may be in a file of their own "
    "(a log of torque commands alone says nothing about a position drive)"
)


def read_table(path: Path, names: ColumnMap) -> Log:
    """Read a log from a file of named arrays or columns.

    Args:
        path: The file.
        names: Names of the fields in the file.

    Returns:
        The log.

    Raises:
        LogError: A field is missing or has the wrong shape.
    """
    fields, joints, remarks = read_fields(path, names)
    check_size(path, {name: np.shape(values) for name, values in fields.items()})
    pickled = next((one for one in remarks if "a pickle" in one), "")
    needed = ("t", "q") if "q_des_cmd" in fields else ("t", "q", "q_des")
    missing = next((name for name in needed if name not in fields), "")
    if missing:
        unused = next((one.removesuffix(UNUSED) for one in remarks if one.endswith(UNUSED)), "")
        more = f"; of {unused}, --columns MAPFILE says which is what" if unused else ""
        raise LogError(
            f"{path}: {missing}: the field is missing, found {', '.join(fields) or 'none'}"
            f"{f'; {pickled}' if pickled else more}{EXPECTED_COMMANDS if missing == 'q_des' else ''}"
        )
    remarks = [one for one in remarks if one != pickled]
    fields, joints = _drop_unmeasured(path, fields, joints, remarks)
    return _log(path, _cut_incomplete_rows(path, fields, remarks), joints, remarks)


def _drop_unmeasured(
    path: Path, fields: Mapping[str, Any], joints: list[str] | None, remarks: list[str]
) -> tuple[dict[str, Any], list[str] | None]:
    """Drop the joints without a number in one of the fields, in all fields; return fields and joints."""
    shape = np.shape(fields["q"])
    of_joints = [
        name for name, values in fields.items() if np.ndim(values) == 2 and np.shape(values)[1:] == shape[1:]
    ]
    empty = {name: np.isnan(fields[name]).all(axis=0) for name in of_joints if len(fields[name])}
    if len(shape) != 2 or not any(one.any() for one in empty.values()):
        return dict(fields), joints
    names = _joints(path, joints, shape[1], remarks)
    for field, one in empty.items():
        if one.any():
            without = format_names([names[k] for k in np.flatnonzero(one)])
            remarks.append(f"{field}: no number for {without}, which is left out in all fields")
    keep = ~np.any(list(empty.values()), axis=0)
    if not keep.any():
        raise LogError(f"{path}: q: no joint holds a number in all of {', '.join(of_joints)}")

    def select(values: Any) -> Any:
        """Keep the measured joints of an array with a column, or a constant, for each joint."""
        own = np.ndim(values) in (1, 2) and np.shape(values)[-1:] == shape[1:]
        return values[..., keep] if own else values

    kept = {name: values if name in ("t", "t_cmd") else select(values) for name, values in fields.items()}
    return kept, [name for name, one in zip(names, keep, strict=True) if one]


def drop_repeated_times(
    field: str, time: Floats, values: Mapping[str, Any], remarks: list[str]
) -> tuple[Floats, dict[str, Any]]:
    """Drop rows whose time equals that of the row before, if these are fewer than half of the rows.

    Where they are more, the time stamps are unusable, and `Log` refuses them.

    Args:
        field: Name of the time base, for the remark.
        time: (N,) times, s.
        values: Arrays with N rows, by field.
        remarks: Receives a remark if rows were dropped.

    Returns:
        The remaining times and arrays.
    """
    if len(time) == 0 or time.ndim != 1:
        return time, dict(values)
    fresh = np.concatenate([[True], np.diff(time) != 0.0])
    repeated = int((~fresh).sum())
    if repeated and 2 * repeated < len(time):
        remarks.append(
            f"{field}: {repeated} of {len(time)} rows repeat a time stamp; the first of each is used"
        )
        return time[fresh], {name: value[fresh] for name, value in values.items()}
    return time, dict(values)


def _cut_incomplete_rows(path: Path, fields: Mapping[str, Floats], remarks: list[str]) -> dict[str, Floats]:
    """Cut trailing rows in which a field misses a value, alike for all fields on the same times.

    Raises LogError if a field would cut half of the rows or more.
    """
    cut = {
        name: values[: count_whole_rows(values)] if values.ndim else values for name, values in fields.items()
    }
    with_states = () if "q_des_cmd" in fields else ("q_des", *COMMAND_FIELDS)
    for base in (("t", *STATE_FIELDS, "voltage", "valid", *with_states), ("t_cmd", "q_des_cmd")):
        shape = fields[base[0]].shape[:1] if base[0] in fields else ()
        alike = [name for name in base if shape and name in fields and fields[name].shape[:1] == shape]
        rows = {name: len(cut[name]) for name in alike}
        whole, most = min(rows.values(), default=0), max(rows.values(), default=0)
        if whole == most:
            continue
        short = min(rows, key=lambda name: rows[name])
        if 2 * whole <= most:
            raise LogError(
                f"{path}: {short}: no value from row {whole} on, expected one in each of {most} rows"
            )
        remarks.append(f"{short}: no value in the last {most - whole} of {most} rows, which are left out")
        cut |= {name: cut[name][:whole] for name in rows}
    return cut


def _log(path: Path, fields: dict[str, Any], names: list[str] | None, remarks: list[str]) -> Log:
    """Make a log from the fields."""
    if "t_cmd" in fields and "q_des_cmd" not in fields:
        remarks.append("t_cmd: not used, as q_des_cmd is not there; q_des is taken at the times t")
    t, q = fields["t"], fields["q"]
    if q.ndim == 1 and (names is None or len(names) == 1):  # of a single joint
        q = q[:, None]
    if names is not None and q.ndim == 1 and q.shape == t.shape:
        raise LogError(f"{path}: joint_names: found {len(names)} names, expected 1, as q has one column")
    if t.ndim != 1 or q.ndim != 2 or len(q) != len(t):
        raise LogError(f"{path}: q: found shape {q.shape}, expected ({t.size}, J): a row for each of t")
    joints = _joints(path, names, q.shape[1], remarks)
    state: dict[str, Any] = {name: fields[name] for name in STATE_FIELDS if name in fields}
    for name in state:
        if len(joints) == 1 or name == "temperature":  # other quantities differ by joint
            state[name] = _per_joint(state[name], len(t), len(joints))
    state["valid"] = _valid(path, fields.get("valid", True), len(t), len(joints))
    if "voltage" in fields:
        state["voltage"] = fields["voltage"]
    for name, values in state.items():
        if len(values) != len(t):
            raise LogError(
                f"{path}: {name}: found shape {values.shape}, expected a row for each of t, {len(t)}"
            )
    t_cmd, command = _commands(path, fields, t, len(joints))
    t, state = drop_repeated_times("t", t, state, remarks)
    t_cmd, command = drop_repeated_times("t_cmd", t_cmd, command, remarks)
    derived = () if "dq" in state else ("dq",)
    if derived and state["q"].shape == (len(t), len(joints)) and (np.diff(t) > 0.0).all():
        state["dq"] = np.gradient(state["q"], t, axis=0)
    return Log(
        name=str(path),
        joints=joints,
        t=t,
        t_cmd=t_cmd,
        **state,
        **command,
        remarks=tuple(remarks),
        derived=derived,
    )


def _joints(path: Path, names: list[str] | None, joints: int, remarks: list[str]) -> tuple[str, ...]:
    """Names of the joints, or default names with a remark."""
    if names is None and joints == len(JOINT_NAMES):
        remarks.append(
            f"joint_names: not there; assumed to be {JOINT_NAMES[0]}, {JOINT_NAMES[1]}, ... (the model's)"
        )
        return JOINT_NAMES
    if names is None:
        remarks.append(f"joint_names: not there; the joints are called 1_joint to {joints}_joint")
        names = [str(number) for number in range(1, joints + 1)]
    if len(names) != joints:
        raise LogError(f"{path}: joint_names: found {len(names)} names, expected {joints} as q has columns")
    return tuple(joint_name(name) for name in names)


def _per_joint(values: Any, rows: int, joints: int) -> Any:
    """Broadcast (rows,) to (rows, joints); return other shapes unchanged."""
    return np.broadcast_to(values[:, None], (rows, joints)) if values.shape == (rows,) else values


def _valid(path: Path, values: Any, rows: int, joints: int) -> Bools:
    """The mask (rows, joints) from flags for each row, each value, or the whole log."""
    values = np.asarray(values)
    if not np.isin(values, (0, 1)).all():
        raise LogError(
            f"{path}: valid: found numbers other than 0 and 1, expected true or false for each row"
        )
    flags = np.broadcast_to(values.astype(bool), (rows,)) if values.ndim == 0 else values.astype(bool)
    return _per_joint(flags, rows, joints)


def _commands(path: Path, fields: dict[str, Any], t: Floats, joints: int) -> tuple[Floats, dict[str, Any]]:
    """Times of the commands, and all fields on them."""
    own = "q_des_cmd" in fields
    if own and "t_cmd" not in fields:
        raise LogError(f"{path}: t_cmd: the field is missing, expected the times of q_des_cmd")
    t_cmd = fields["t_cmd"] if own else t
    name = "q_des_cmd" if own else "q_des"
    q_des = _per_joint(fields[name], len(t_cmd), joints) if joints == 1 else fields[name]
    if q_des.shape != (len(t_cmd), joints):
        raise LogError(f"{path}: {name}: found shape {q_des.shape}, expected {(len(t_cmd), joints)}")
    command = {"q_des": q_des}
    for name in COMMAND_FIELDS:
        if name in fields:
            command[name] = _on_commands(path, name, fields[name], t, t_cmd, joints)
    return t_cmd, command


def _on_commands(path: Path, name: str, values: Floats, t: Floats, t_cmd: Floats, joints: int) -> Floats:
    """Bring one value, one for each joint, or rows on either time base to shape (M, J)."""
    if values.size == 1 or values.shape == (joints,):
        return np.broadcast_to(values.reshape(-1), (len(t_cmd), joints))
    if values.shape in ((len(t_cmd),), (len(t_cmd), joints)):
        return _per_joint(values, len(t_cmd), joints)
    if values.shape in ((len(t),), (len(t), joints)):
        newest = np.maximum(np.searchsorted(t, t_cmd, side="right") - 1, 0)
        return _per_joint(values[newest], len(t_cmd), joints)
    raise LogError(
        f"{path}: {name}: found shape {values.shape}, expected one number, {joints}, "
        f"or rows for each of t ({len(t)}) or of the commands ({len(t_cmd)})"
    )
