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

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from quadvel_description.bounded_yaml import read_yaml

from . import files
from .findings import some
from .log import Array, LogError
from .names import FIELDS, NAMES, WHOLE, resolve
from .raw import Raw
from .units import factor


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
    scale: float | list[float] | None = None
    """None: the unit that the file states counts, or else SI"""
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
        scale, value, file = entry.get("scale"), entry.get("value"), entry.get("file")
        for field, good, expected in (
            ("from", all(isinstance(name, str) for name in names), "a name or a list of names"),
            ("scale", scale is None or _numbers(scale), "a number, or one for each joint"),
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
            given = read_yaml(path, "a YAML file of column names")
        except ValueError as error:
            raise LogError(str(error)) from None
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
        raw = files.read(place, partial(_choose, plain, mine))
        remarks += raw.remarks
        if plain and joints is None and NAMES in raw.arrays:
            joints = [str(name).strip() for name in np.ravel(raw.arrays[NAMES])]
        for name, source in mine.items():
            if source.value is not None:
                fields[name] = np.asarray(source.value, dtype=float)
            elif source.columns:
                columns, own = _columns_of(place, name, source.columns, raw, joints)
                fields[name] = _stacked(place, name, columns, raw, source.scale)
                joints = joints or (own if name == "q" else None)
        if plain:
            joints = _plain(place, raw, names, fields, joints, remarks)
    return fields, joints, remarks


def _choose(plain: bool, sources: Mapping[str, Source], there: Sequence[str]) -> dict[str, str]:
    """Of all names in a file those that are needed, each with its field."""
    chosen: dict[str, str] = {}
    for field, source in sources.items():
        for column in source.columns:
            chosen |= {name: field for name in there if name == column or name.startswith(f"{column}/")}
    if plain:
        for field, columns in _resolved(there, sources).items():
            chosen |= {name: field for name in columns.values() if name not in chosen}
        chosen |= {NAMES: NAMES} if NAMES in there else {}
    return chosen


def _resolved(there: Sequence[str], sources: Mapping[str, Source]) -> dict[str, dict[str, str]]:
    """The columns of the fields that no map names; a map's own columns hold nothing else."""
    used = {column for one in sources.values() if one.file is None for column in one.columns}
    free = [name for name in there if name not in used and name.partition("/")[0] not in used]
    return {field: columns for field, columns in resolve(free).items() if field not in sources}


def _plain(
    path: Path,
    raw: Raw,
    names: ColumnMap,
    fields: dict[str, Array],
    joints: list[str] | None,
    remarks: list[str],
) -> list[str] | None:
    """Adds the fields that no map names, by their own names or aliases; the joints as q's columns name them."""
    used = {column for one in names.sources.values() if one.file is None for column in one.columns}
    found = _resolved([*raw.arrays, *raw.others], names.sources)
    for field, columns in found.items():
        column = next(iter(columns.values()))
        own = [joint for joint in columns if joint != WHOLE]
        if column.partition("/")[0] != field:
            remarks.append(f"{field}: read from {some([repr(name) for name in columns.values()])}")
        if own:
            joints, ordered = _in_order(path, field, own, joints)
            columns = {joint: columns[joint] for joint in ordered}
        fields[field] = _stacked(path, field, list(columns.values()), raw, None, own != [])
        used |= set(columns.values())
    others = [
        name for name in (*raw.others, *raw.arrays) if name and name != NAMES and not _is_used(name, used)
    ]
    if others:
        remarks.append(f"{others[0]}: not used, as no log has such fields: {some(others)}")
    return joints


def _is_used(name: str, used: Collection[str]) -> bool:
    return name in used or name.partition("/")[0] in used


def _in_order(
    path: Path, field: str, own: list[str], joints: list[str] | None
) -> tuple[list[str], list[str]]:
    """The log's joints once a field's columns name `own`, and those columns in their order."""
    if joints and sorted(own) == sorted(joints):
        return joints, joints
    if joints and field != "q":
        odd = sorted(set(own) ^ set(joints))
        raise LogError(f"{path}: {field}/{odd[0]}: the columns of {field} and of q name different joints")
    return (own if field == "q" or joints is None else joints), own


def _columns_of(
    path: Path, field: str, columns: tuple[str, ...], raw: Raw, joints: list[str] | None
) -> tuple[list[str], list[str] | None]:
    """The columns that a map means, and the joints that they name: `positions` may stand for `positions/knee`."""
    if len(columns) == 1 and columns[0] not in raw.arrays:
        of_joints = {name.partition("/")[2]: name for name in raw.arrays if name.startswith(f"{columns[0]}/")}
        if of_joints:
            _, ordered = _in_order(path, field, list(of_joints), joints)
            return [of_joints[joint] for joint in ordered], ordered
    for name in columns:
        if name not in raw.arrays:
            raise LogError(
                f"{path}: {field}: no '{name}' in it, found {some([*raw.arrays, *raw.others], 12)}"
            )
    return list(columns), None


def _stacked(
    path: Path,
    field: str,
    columns: Sequence[str],
    raw: Raw,
    scale: float | list[float] | None,
    of_joints: bool = False,
) -> Array:
    """One array of the columns in SI units, without the rows at its end that hold no number."""
    parts = [raw.arrays[name] * _scale(path, name, raw.units.get(name), scale) for name in columns]
    values = np.stack(parts, 1) if len(columns) > 1 or of_joints else parts[0]
    if scale is not None:
        values = values * np.asarray(scale)
    if values.ndim == 0:
        return values
    there = ~np.isnan(values)
    whole = np.flatnonzero(there if there.ndim == 1 else there.all(axis=1))
    if len(values) and not whole.size:
        raise LogError(
            f"{path}: {field}: no row holds a number for each joint, {len(values)} rows are not finite"
        )
    return values[: whole[-1] + 1 if whole.size else 0]


def _scale(path: Path, column: str, unit: str | None, scale: Any) -> float:
    """The factor to SI that a file's own unit asks for, where no map says what counts."""
    if unit is None or scale is not None:
        return 1.0
    found = factor(unit)
    if found is None:
        raise LogError(
            f"{path}: {column}: the unit '{unit}' is unknown, expected s, rad, N m or the like; --columns gives its scale"
        )
    return found
