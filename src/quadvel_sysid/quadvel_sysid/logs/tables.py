"""Logs out of NPZ archives and CSV tables: the named arrays of `docs/identification.md`, for any robot.

Sizes are looked at before anything is read: an archive may promise more than memory holds.
"""

from __future__ import annotations

import math
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike

from quadvel_description.robot import JOINT_NAMES

from .log import Array, Bools, Log, LogError, joint_name

LONG = 16_000_000
"""Values (128 MB in double precision) above which a log is kept in single precision."""
LARGEST = 120_000_000
"""Values: 20 minutes of 12 joints at 1 kHz with 8 quantities."""

STATE_FIELDS = ("q", "dq", "tau", "temperature")
COMMAND_FIELDS = ("dq_des", "tau_ff")
GAIN_FIELDS = ("kp", "kd")
FIELDS = (
    *("t", "t_cmd", "q_des", "q_des_cmd", "voltage", "valid", "joint_names"),
    *STATE_FIELDS,
    *COMMAND_FIELDS,
    *GAIN_FIELDS,
)
NEEDED = ("t", "q", "dq")

LINES = 20_000  # of a CSV file, read at once
LONGEST_LINE = 1 << 20  # characters


def precision(values: int) -> DTypeLike:
    """What a log of so many values is kept in."""
    return np.float64 if values <= LONG else np.float32


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


def read_npz(path: Path) -> Log:
    """An archive as `numpy.savez` writes it. Raises LogError."""
    try:
        with zipfile.ZipFile(path) as archive:
            shapes = dict(_headers(path, archive))
            _check_size(path, {name: shape for name, (shape, _) in shapes.items()})
            dtype = precision(sum(math.prod(shape) for shape, _ in shapes.values()))
            unknown = [
                name
                for name in (one.removesuffix(".npy") for one in archive.namelist())
                if name not in FIELDS
            ]
            fields = {
                name: _array(archive, name, None if name in ("t", "t_cmd", "joint_names") else dtype)
                for name in shapes
            }
    except (zipfile.BadZipFile, EOFError, zlib.error, NotImplementedError) as error:
        if path.stat().st_size == 0:
            raise LogError(f"{path}: the file is empty, expected an NPZ archive") from None
        raise LogError(f"{path}: no whole NPZ archive: {error or 'it is cut off'}") from None
    names = fields.pop("joint_names", None)
    return _log(path, fields, None if names is None else [str(name) for name in np.ravel(names)], unknown)


def _headers(
    path: Path, archive: zipfile.ZipFile
) -> Iterator[tuple[str, tuple[tuple[int, ...], np.dtype[Any]]]]:
    """Field, shape and type of the archive's arrays that belong to a log, without reading one."""
    for member in archive.namelist():
        name = member.removesuffix(".npy")
        if name not in FIELDS or member == name:
            continue
        with archive.open(member) as file:
            try:
                version = npy.read_magic(file)
                read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
                shape, _, dtype = read_header(file)
            except ValueError as error:
                raise LogError(f"{path}: {name}: no NumPy array: {error}") from None
        kinds = "US" if name == "joint_names" else "biuf"
        if dtype.kind not in kinds:
            expected = "text" if name == "joint_names" else "numbers"
            raise LogError(f"{path}: {name}: found the type {dtype}, expected {expected}")
        if min(shape, default=0) < 0:
            raise LogError(f"{path}: {name}: found shape {shape}, expected no length below 0")
        if dtype.kind in "US" and math.prod(shape) * dtype.itemsize > LONGEST_LINE:
            raise LogError(f"{path}: {name}: found {shape} names, expected one a joint")
        yield name, (shape, dtype)


def _array(archive: zipfile.ZipFile, name: str, dtype: DTypeLike | None) -> Any:
    with archive.open(f"{name}.npy") as file:
        try:
            values = npy.read_array(file, allow_pickle=False)
        except ValueError as error:
            raise EOFError(f"{name}: {error}") from None
    return values if dtype is None else values.astype(dtype, copy=False)


def _check_size(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> None:
    for name in NEEDED:
        if name not in shapes:
            raise LogError(f"{path}: {name}: the field is missing, found {', '.join(shapes) or 'none'}")
    size = {name: math.prod(shape) for name, shape in shapes.items()}
    total = sum(size.values())
    if total > LARGEST:
        largest = max(size, key=lambda name: size[name])
        raise LogError(
            f"{path}: {largest}: found shape {shapes[largest]}, {total} values with the other fields, "
            f"expected {LARGEST} at most; cut the log"
        )


def read_csv(path: Path) -> Log:
    """A table with columns `t`, `q/JOINT`, ...; cells behind the end of a shorter time base are empty."""
    with path.open(encoding="utf-8", errors="replace") as file:
        header = file.readline(LONGEST_LINE)
        if "\0" in header or not header.endswith("\n"):
            raise LogError(
                f"{path}: the first line is no header, expected the columns t, q/FR_hip_joint, ..."
            )
        columns = [cell.strip().strip('"') for cell in header.strip().lstrip("\ufeff").split(",")]
        for column, times in Counter(columns).items():
            if times > 1:
                raise LogError(f"{path}: {column}: the column stands there twice")
        if "t" not in columns:
            raise LogError(
                f"{path}: t: no such column in the first line ({header.strip()[:60]!r}); expected t, q/FR_hip_joint, ... "
                "with commas between"
            )
        known = [k for k, column in enumerate(columns) if column.partition("/")[0] in FIELDS]
        lines = max(1, path.stat().st_size // max(1, 2 * len(columns)))
        dtype = precision(lines * len(known) // 4)  # a number takes about eight characters
        blocks = list(_blocks(path, file, columns, known, dtype))
    if not blocks:
        raise LogError(f"{path}: t: the table has no rows")
    unknown = [column for column in columns if column.partition("/")[0] not in FIELDS]
    return _log(path, *_fields(path, [columns[k] for k in known], blocks), unknown)


def _blocks(
    path: Path, file: IO[str], columns: list[str], known: list[int], dtype: DTypeLike
) -> Iterator[tuple[Array, Array]]:
    """The two time columns in double precision (NaN where there is none), and all known columns."""
    clocks = [columns.index(name) if name in columns else -1 for name in ("t", "t_cmd")]
    rows = 0
    while lines := list(islice(iter(lambda: file.readline(LONGEST_LINE), ""), LINES)):
        lines = [_cells(line) for line in lines if line.strip()]
        if not lines:
            continue
        try:
            values = np.loadtxt(lines, delimiter=",", ndmin=2, comments=None)
            if values.shape[1] != len(columns):
                raise ValueError
        except ValueError:
            raise LogError(f"{path}: {_odd_cell(lines, columns, rows + 2)}") from None
        rows += len(lines)
        if rows * len(known) > LARGEST:
            raise LogError(f"{path}: more than {LARGEST} values, expected fewer; cut the log")
        time = np.stack([values[:, k] if k >= 0 else np.full(len(lines), np.nan) for k in clocks], 1)
        yield time, values[:, known].astype(dtype)


def _odd_cell(lines: list[str], columns: list[str], first: int) -> str:
    """The first cell that is no number, or the first line with too few or too many; `first` is the number of its line."""
    for number, line in enumerate(lines, first):
        cells = line.split(",")
        if len(cells) != len(columns):
            return f"line {number}: found {len(cells)} cells, expected {len(columns)} as the header has, with commas between"
        for column, cell in zip(columns, cells, strict=True):
            try:
                float(cell)
            except ValueError:
                return (
                    f"line {number}: {column}: found {cell.strip()!r}, expected a number with a decimal point"
                )
    return f"lines {first} to {first + len(lines) - 1}: found what is no table, expected numbers with commas between"


def _cells(line: str) -> str:
    """The line with a number in each cell: NaN where it is empty."""
    line = line.strip().replace("True", "1").replace("False", "0")
    return re.sub(r"(?<=,)\s*(?=,|$)", "nan", "," + line)[1:]


def _fields(
    path: Path, columns: list[str], blocks: list[tuple[Array, Array]]
) -> tuple[dict[str, Any], list[str] | None]:
    """The columns as named arrays, each cut behind its last number; the joints as q's columns name them."""
    joints = [column.partition("/")[2] for column in columns if column.startswith("q/")]
    time = np.concatenate([time for time, _ in blocks])
    fields: dict[str, Any] = {"t": time[:, 0], "t_cmd": time[:, 1]}
    for name in dict.fromkeys(column.partition("/")[0] for column in columns):
        here = {
            column.partition("/")[2]: k
            for k, column in enumerate(columns)
            if column.partition("/")[0] == name
        }
        if name in fields or name == "joint_names":
            continue
        if "" in here and len(here) == 1:
            chosen: int | list[int] = here[""]
        elif sorted(here) == sorted(joints):
            chosen = [here[joint] for joint in joints]
        else:
            odd = sorted(set(here) ^ set(joints))
            raise LogError(f"{path}: {name}/{odd[0]}: the columns of {name} and of q name different joints")
        fields[name] = np.concatenate([values[:, chosen] for _, values in blocks])
    fields = {name: _cut(values) for name, values in fields.items()}
    return {name: values for name, values in fields.items() if len(values)}, joints or None


def _cut(values: Array) -> Array:
    """Without the rows at the end that hold no number."""
    there = np.flatnonzero(~np.isnan(values).reshape(len(values), -1).all(1))
    return values[: there[-1] + 1 if there.size else 0]


def _log(path: Path, fields: dict[str, Any], names: list[str] | None, unknown: list[str]) -> Log:
    """The fields, of whatever file, as a log: shapes made equal, one time base for all that was commanded.

    `unknown` are the fields of the file that are none of a log.
    """
    remarks: list[str] = []
    if unknown:
        more = f" and {len(unknown) - 4} more" if len(unknown) > 4 else ""
        remarks.append(f"{unknown[0]}: not used, as no log has such fields: {', '.join(unknown[:4])}{more}")
    if "t_cmd" in fields and "q_des_cmd" not in fields:
        remarks.append("t_cmd: not used, as q_des_cmd is not there; q_des counts on the times t")
    _check_size(path, {name: np.shape(values) for name, values in fields.items()})
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
    return Log(name=str(path), joints=joints, t=t, t_cmd=t_cmd, **state, **command, remarks=tuple(remarks))


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
        torque = " (a log of torque commands alone says nothing about a position drive)"
        raise LogError(f"{path}: q_des: the field is missing, expected q_des, or t_cmd and q_des_cmd{torque}")
    t_cmd = fields["t_cmd"] if own else t
    name = "q_des_cmd" if own else "q_des"
    q_des = _table(fields[name], len(t_cmd), joints) if joints == 1 else fields[name]
    if q_des.shape != (len(t_cmd), joints):
        raise LogError(f"{path}: {name}: found shape {q_des.shape}, expected {(len(t_cmd), joints)}")
    command = {"q_des": q_des}
    for name in (*COMMAND_FIELDS, *GAIN_FIELDS):
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
