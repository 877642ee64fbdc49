"""What a log's fields are called in a file: by their own names, by names that others use, or as a map file says.

A map file is YAML, a line for each field that is called otherwise:

    t: {from: timestamp, scale: 1.0e-6}        # times 1e-6: microseconds
    q: positions                               # cells with lists, an (N, J) array, or columns positions/JOINT
    dq: [hip_speed, knee_speed]                # a column for each joint
    tau: null                                  # left out
    kp: {value: 35.0}                          # not in the file
    q_des: {from: goal, scale: [1.0, -1.0]}    # for each joint
    t_cmd: {from: timestamp, scale: 1.0e-6, file: [state, control]}    # in another file: `state` in its name is `control`
    q_des_cmd: {from: positions, file: [state, control]}
    joint_names: [hip, knee]
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import yaml

from . import files
from .findings import some
from .log import Array, LogError

FIELDS = (
    "t", "q", "dq", "tau", "q_des", "t_cmd", "q_des_cmd", "dq_des", "tau_ff", "kp", "kd", "temperature", "voltage", "valid",
)  # fmt: skip
NAMES = "joint_names"
ALIASES = {
    "t": ("time", "timestamp"),
    "q": ("dof_pos", "position", "positions"),
    "dq": ("dof_vel", "velocity", "velocities", "speed"),
    "tau": ("effort", "torque", "torques"),
    "q_des": ("des_dof_pos", "goal_position"),
}
"""What PACE, the message JointState, SAGE and BAM call them; taken where a field is not there by its own name."""


def _known(mapping: Mapping[str, Any], known: tuple[str, ...], where: str) -> None:
    for name in mapping:
        if name not in known:
            raise LogError(f"{where}{name}: unknown, expected one of {', '.join(known)}")


def _numbers(value: Any) -> bool:
    values = value if isinstance(value, list) else [value]
    return all(isinstance(one, (int, float)) and not isinstance(one, bool) for one in values)


@attrs.frozen
class Source:
    """Where a field stands: in `columns` of a file, times `scale`, or nowhere, with one `value`, or left out."""

    columns: tuple[str, ...] = ()
    scale: float | list[float] = 1.0
    value: Any = None
    file: tuple[str, str] | None = None
    """what of the log's own file name is replaced by what, where the field stands in another file"""

    @classmethod
    def of(cls, given: Any, where: str) -> Source:
        """As a map file says it. Raises LogError."""
        entry = given if isinstance(given, dict) else {"from": given}
        _known(entry, ("from", "scale", "value", "file"), f"{where}/")
        names = entry.get("from")
        names = names if isinstance(names, list) else [] if names is None else [names]
        scale, value, file = entry.get("scale", 1.0), entry.get("value"), entry.get("file")
        for field, good, expected in (
            ("from", all(isinstance(name, str) for name in names), "a name or a list of names"),
            ("scale", _numbers(scale), "a number, or one for each joint"),
            ("value", value is None or _numbers(value), "a number, or one for each joint"),
            (
                "file",
                file is None or (isinstance(file, list) and len(file) == 2 and all(isinstance(x, str) for x in file)),
                "two parts of a file name, the second in place of the first",
            ),
        ):  # fmt: skip
            if not good:
                raise LogError(f"{where}/{field}: found {entry[field]!r}, expected {expected}")
        return cls(tuple(names), scale, value, tuple(file) if file else None)

    def stands_in(self, path: Path) -> Path:
        """The file that the field stands in, where its log is `path`."""
        return path if self.file is None else path.with_name(path.name.replace(*self.file))


@attrs.frozen
class ColumnMap:
    """What a map file says, by field; a field that it does not name is called as usual."""

    sources: Mapping[str, Source] = attrs.field(factory=dict)
    joints: tuple[str, ...] = ()

    @classmethod
    def load(cls, path: Path) -> ColumnMap:
        """Read a map file. Raises LogError, which names the entry, and OSError."""
        try:
            given = yaml.safe_load(path.read_text())
        except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
            raise LogError(f"{path}: no valid YAML: {' '.join(str(error).split())[:200]}") from None
        if not isinstance(given, dict):
            raise LogError(
                f"{path}: found {str(given)[:60]!r}, expected a line for each field, such as q: dof_pos"
            )
        _known(given, (*FIELDS, NAMES), f"{path}: ")
        joints = given.pop(NAMES, [])
        if not isinstance(joints, list) or not all(isinstance(name, str) for name in joints):
            raise LogError(f"{path}: {NAMES}: found {joints!r}, expected a list of names")
        return cls({name: Source.of(one, f"{path}: {name}") for name, one in given.items()}, tuple(joints))


def read(path: Path, names: ColumnMap) -> tuple[dict[str, Array], list[str] | None, list[str]]:
    """The fields of a log's file or files, the names of its joints where they are there, and what was assumed."""
    fields: dict[str, Array] = {}
    remarks: list[str] = []
    joints: list[str] | None = list(names.joints) or None
    places = dict.fromkeys([path, *(source.stands_in(path) for source in names.sources.values())])
    for place in places:
        mine = {name: one for name, one in names.sources.items() if one.stands_in(path) == place}
        plain = place == path
        raw = files.read(place, partial(_is_wanted, plain, mine))
        if plain and joints is None and NAMES in raw.arrays:
            joints = [str(name) for name in np.ravel(raw.arrays[NAMES])]
        for name, source in mine.items():
            if source.value is not None:
                fields[name] = np.asarray(source.value, dtype=float)
            elif source.columns:
                fields[name] = _stacked(place, name, source.columns, raw.arrays, joints)[0] * np.asarray(
                    source.scale
                )
        if plain:
            joints = _plain(place, raw, names, fields, joints, remarks)
    return fields, joints, remarks


def _is_wanted(plain: bool, sources: Mapping[str, Source], name: str) -> bool:
    base = name.partition("/")[0]
    if any(base == column or name == column for one in sources.values() for column in one.columns):
        return True
    if not plain:
        return False
    usual = (*FIELDS, NAMES, *(alias for names in ALIASES.values() for alias in names))
    return base in usual


def _plain(
    path: Path,
    raw: files.Raw,
    names: ColumnMap,
    fields: dict[str, Array],
    joints: list[str] | None,
    remarks: list[str],
) -> list[str] | None:
    """Adds the fields that no map names, by their own names or aliases; the joints as q's columns name them."""
    there = {name.partition("/")[0] for name in raw.arrays}
    used = {column for one in names.sources.values() if one.file is None for column in one.columns}
    for name in FIELDS:
        if name in names.sources:
            continue
        column = next((one for one in (name, *ALIASES.get(name, ())) if one in there - used), None)
        if column is None:
            continue
        if column != name:
            remarks.append(f"{name}: read from '{column}'")
            used.add(column)
        fields[name], own = _stacked(path, name, (column,), raw.arrays, joints)
        joints = own if name == "q" and own else joints
    others = [
        *raw.others,
        *(one for one in raw.arrays if one.partition("/")[0] not in {*FIELDS, NAMES, *used}),
    ]
    if others:
        remarks.append(f"{others[0]}: not used, as no log has such fields: {some(others)}")
    return joints


def _stacked(
    path: Path, field: str, columns: tuple[str, ...], arrays: Mapping[str, Any], joints: list[str] | None
) -> tuple[Array, list[str] | None]:
    """One array of the columns, without the rows at its end that hold no number, and the joints that they name."""
    own = None
    if len(columns) == 1 and columns[0] not in arrays:
        of_joints = {name.partition("/")[2]: name for name in arrays if name.startswith(f"{columns[0]}/")}
        own = list(of_joints)
        if own and joints and sorted(own) == sorted(joints):
            own = joints
        elif own and joints and field != "q":
            odd = sorted(set(own) ^ set(joints))
            raise LogError(f"{path}: {field}/{odd[0]}: the columns of {field} and of q name different joints")
        columns = tuple(of_joints[joint] for joint in own) or columns
    for name in columns:
        if name not in arrays:
            raise LogError(f"{path}: {field}: no '{name}' in it, found {some(list(arrays), 12)}")
    values = (
        arrays[columns[0]]
        if len(columns) == 1 and own is None
        else np.stack([arrays[one] for one in columns], 1)
    )
    if values.ndim == 0:
        return values, own
    there = ~np.isnan(values)
    whole = np.flatnonzero(there if there.ndim == 1 else there.all(axis=1))
    return values[: whole[-1] + 1 if whole.size else 0], own
