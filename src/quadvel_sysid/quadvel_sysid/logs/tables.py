"""A log out of named arrays: shapes made equal, one time base for all that was commanded, and what had to be assumed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadvel_description.robot import JOINT_NAMES

from .columns import ColumnMap, read
from .log import Array, Bools, Log, LogError, joint_name
from .raw import check_size

STATE_FIELDS = ("q", "dq", "tau", "temperature")
COMMAND_FIELDS = ("dq_des", "tau_ff", "kp", "kd")


def read_table(path: Path, names: ColumnMap) -> Log:
    """The log in an NPZ, CSV or JSON file, whose fields are called as `names` says. Raises LogError."""
    fields, joints, remarks = read(path, names)
    check_size(path, {name: np.shape(values) for name, values in fields.items()})
    for name in ("t", "q"):
        if name not in fields:
            there = ", ".join(fields) or "none"
            more = next((one for one in remarks if "not used" in one), "").partition("such fields: ")[2]
            more = f"; of {more}, --columns MAPFILE says which is what" if more else ""
            raise LogError(f"{path}: {name}: the field is missing, found {there}{more}")
    return _log(path, fields, joints, remarks)


def drop_repeated_times(
    field: str, time: Array, values: Mapping[str, Any], remarks: list[str]
) -> tuple[Array, dict[str, Any]]:
    """Without the rows whose time is that of the row before; a remark says how many there were."""
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


def _log(path: Path, fields: dict[str, Any], names: list[str] | None, remarks: list[str]) -> Log:
    """The fields, of whatever file, as a log."""
    if "t_cmd" in fields and "q_des_cmd" not in fields:
        remarks.append("t_cmd: not used, as q_des_cmd is not there; q_des counts on the times t")
    t, q = fields["t"], fields["q"]
    if q.ndim == 1 == (1 if names is None else len(names)):
        q = q[:, None]
    if t.ndim != 1 or q.ndim != 2 or len(q) != len(t):
        raise LogError(f"{path}: q: found shape {q.shape}, expected ({t.size}, J): a row for each of t")
    joints = _joints(path, names, q.shape[1], remarks)
    state: dict[str, Any] = {name: fields[name] for name in STATE_FIELDS if name in fields}
    for name in state:
        if len(joints) == 1 or name == "temperature":  # one number for all joints makes sense of no other
            state[name] = _table(state[name], len(t), len(joints))
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
    made = () if "dq" in state else ("dq",)
    if made and state["q"].shape == (len(t), len(joints)) and (np.diff(t) > 0.0).all():
        state["dq"] = np.gradient(state["q"], t, axis=0)
    return Log(
        name=str(path), joints=joints, t=t, t_cmd=t_cmd, **state, **command, remarks=tuple(remarks), made=made
    )


def _joints(path: Path, names: list[str] | None, joints: int, remarks: list[str]) -> tuple[str, ...]:
    if names is None and joints == len(JOINT_NAMES):
        remarks.append(
            f"joint_names: not there; taken as {JOINT_NAMES[0]}, {JOINT_NAMES[1]}, ... (the model's)"
        )
        return JOINT_NAMES
    if names is None:
        remarks.append(f"joint_names: not there; the joints are called 1_joint to {joints}_joint")
        names = [str(number) for number in range(1, joints + 1)]
    if len(names) != joints:
        raise LogError(f"{path}: joint_names: found {len(names)} names, expected {joints} as q has columns")
    return tuple(joint_name(name) for name in names)


def _table(values: Any, rows: int, joints: int) -> Any:
    """(rows,) as (rows, joints), everything else as it is."""
    return np.broadcast_to(values[:, None], (rows, joints)) if values.shape == (rows,) else values


def _valid(path: Path, values: Any, rows: int, joints: int) -> Bools:
    values = np.asarray(values)
    if not np.isin(values, (0, 1)).all():
        raise LogError(
            f"{path}: valid: found numbers other than 0 and 1, expected true or false for each row"
        )
    flags = np.broadcast_to(values.astype(bool), (rows,)) if values.ndim == 0 else values.astype(bool)
    return _table(flags, rows, joints)


def _commands(path: Path, fields: dict[str, Any], t: Array, joints: int) -> tuple[Array, dict[str, Any]]:
    """The time base of the commands and all that is given on it."""
    own = "q_des_cmd" in fields
    if own and "t_cmd" not in fields:
        raise LogError(f"{path}: t_cmd: the field is missing, expected the times of q_des_cmd")
    if not own and "q_des" not in fields:
        text = "expected q_des, or t_cmd and q_des_cmd; --columns MAPFILE reads other names, and files of their own"
        torque = "(a log of torque commands alone says nothing about a position drive)"
        raise LogError(f"{path}: q_des: the field is missing, {text} {torque}")
    t_cmd = fields["t_cmd"] if own else t
    name = "q_des_cmd" if own else "q_des"
    q_des = _table(fields[name], len(t_cmd), joints) if joints == 1 else fields[name]
    if q_des.shape != (len(t_cmd), joints):
        raise LogError(f"{path}: {name}: found shape {q_des.shape}, expected {(len(t_cmd), joints)}")
    command = {"q_des": q_des}
    for name in COMMAND_FIELDS:
        if name in fields:
            command[name] = _on_commands(path, name, fields[name], t, t_cmd, joints)
    return t_cmd, command


def _on_commands(path: Path, name: str, values: Array, t: Array, t_cmd: Array, joints: int) -> Array:
    """One value, one a joint, or rows on either time base, as (M, J) without a copy where that is possible."""
    if values.size == 1 or values.shape == (joints,):
        return np.broadcast_to(values.reshape(-1), (len(t_cmd), joints))
    if values.shape in ((len(t_cmd),), (len(t_cmd), joints)):
        return _table(values, len(t_cmd), joints)
    if values.shape in ((len(t),), (len(t), joints)):
        newest = np.maximum(np.searchsorted(t, t_cmd, side="right") - 1, 0)
        return _table(values[newest], len(t_cmd), joints)
    raise LogError(
        f"{path}: {name}: found shape {values.shape}, expected one number, {joints}, "
        f"or rows for each of t ({len(t)}) or of the commands ({len(t_cmd)})"
    )
