"""Read the fields of a log from a file, whatever its columns are called.

A column counts as a field if it has its name or an alias (`names`), or if a map file assigns it.

A map file is YAML with one line for each field that has another name:

    t: {from: timestamp, scale: 1.0e-6}        # times 1e-6: microseconds
    q: positions                               # an (N, J) array, or columns positions/JOINT
    dq: [hip_speed, knee_speed]                # a column for each joint
    tau: null                                  # left out
    kp: {value: 35.0}                          # not in the file
    q_des: {from: goal, scale: [1.0, -1.0]}    # for each joint
    # In another file, whose name has `control` in place of `state`:
    t_cmd: {from: timestamp, scale: 1.0e-6, file: [state, control]}
    q_des_cmd: {from: positions, file: [state, control]}
    joint_names: [hip, knee]
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Floats
from quadvel_description.bounded_yaml import read_yaml
from quadvel_description.name_list import format_names

from ..log import LogError, joint_name
from . import files
from .names import ALL_JOINTS, FIELDS, JOINT_NAMES_FIELD, resolve_columns
from .raw import RawArrays
from .units import si_factor

UNUSED = ": not used, as no field is read from columns of this name"
"""End of the remark that lists such columns."""


def _check_keys(mapping: Mapping[str, Any], known: tuple[str, ...], where: str) -> None:
    """Raise LogError for a key that is not known."""
    for name in mapping:
        if name not in known:
            raise LogError(f"{where}{name}: unknown, expected one of {', '.join(known)}")


def _is_numeric(value: Any) -> bool:
    """Whether a value of YAML is a number or a list of numbers."""
    values = value if isinstance(value, list) else [value]
    return all(isinstance(one, (int, float)) and not isinstance(one, bool) for one in values)


def _yaml_number(value: Any) -> Any:
    """Convert texts such as 1e-6, which YAML 1.1 takes for no numbers, alone or in a list."""
    if isinstance(value, list):
        return [_yaml_number(one) for one in value]
    is_number = isinstance(value, str) and re.fullmatch(r"[-+]?\d+\.?\d*[eE][-+]?\d+", value)
    return float(value) if is_number else value


@attrs.frozen
class Source:
    """Where a map file finds one field: in columns of a file, as a constant, or not at all.

    Attributes:
        columns: Names of the columns; empty if the field is constant or left out.
        scale: Factor to SI units, one or one for each joint. None: the unit that the file states,
            else SI.
        value: Constant value, one or one for each joint, or None.
        file: For a field in another file: the part of the log's file name to replace, and its
            replacement.
    """

    columns: tuple[str, ...] = ()
    scale: float | list[float] | None = None
    value: Any = None
    file: tuple[str, str] | None = None

    @classmethod
    def parse(cls, given: Any, where: str) -> Source:
        """Parse one entry of a map file.

        Args:
            given: The entry as YAML gives it.
            where: File and field, for error messages.

        Returns:
            The source.

        Raises:
            LogError: A key is unknown or a value has the wrong type.
        """
        entry = given if isinstance(given, dict) else {"from": given}
        _check_keys(entry, ("from", "scale", "value", "file"), f"{where}/")
        names = entry.get("from")
        names = names if isinstance(names, list) else [] if names is None else [names]
        scale, value = _yaml_number(entry.get("scale")), _yaml_number(entry.get("value"))
        file = entry.get("file")
        for field, good, expected in (
            ("from", all(isinstance(name, str) for name in names), "a name or a list of names"),
            (
                "scale",
                scale is None or (_is_numeric(scale) and np.all(np.asarray(scale, dtype=float))),
                "a number other than 0, or one for each joint",
            ),
            ("value", value is None or _is_numeric(value), "a number, or one for each joint"),
            (
                "file",
                file is None or (isinstance(file, list) and len(file) == 2 and all(isinstance(x, str) for x in file)),
                "two parts of a file name, the second in place of the first",
            ),
        ):  # fmt: skip
            if not good:
                raise LogError(f"{where}/{field}: found {entry[field]!r}, expected {expected}")
        return cls(tuple(names), scale, value, tuple(file) if file else None)

    def file_of(self, path: Path) -> Path:
        """Return the file that holds the field.

        Args:
            path: The log's own file.

        Returns:
            Path of the file.
        """
        return path if self.file is None else path.with_name(path.name.replace(*self.file))


@attrs.frozen
class ColumnMap:
    """A parsed map file. Fields without an entry keep their usual names.

    Attributes:
        sources: Source of each field that has an entry.
        joints: Names of the joints, in the order of the columns; empty if not given.
    """

    sources: Mapping[str, Source] = attrs.field(factory=dict)
    joints: tuple[str, ...] = ()

    @classmethod
    def load(cls, path: Path) -> ColumnMap:
        """Read a map file.

        Args:
            path: The file.

        Returns:
            The map.

        Raises:
            LogError: An entry is wrong; the message names it.
            OSError: The file cannot be read.
        """
        try:
            given = read_yaml(path, "a YAML file of column names")
        except ValueError as error:
            raise LogError(str(error)) from None
        if not isinstance(given, dict):
            raise LogError(
                f"{path}: found {str(given)[:60]!r}, expected a line for each field, such as q: dof_pos"
            )
        _check_keys(given, (*FIELDS, JOINT_NAMES_FIELD), f"{path}: ")
        joints = given.pop(JOINT_NAMES_FIELD, [])
        if not isinstance(joints, list) or not all(isinstance(name, str) for name in joints):
            raise LogError(f"{path}: {JOINT_NAMES_FIELD}: found {joints!r}, expected a list of names")
        return cls({name: Source.parse(one, f"{path}: {name}") for name, one in given.items()}, tuple(joints))


def read_fields(path: Path, names: ColumnMap) -> tuple[dict[str, Floats], list[str] | None, list[str]]:
    """Read the fields of a log from its file or files.

    Args:
        path: The log's own file.
        names: The map of columns.

    Returns:
        Arrays by field in SI units, (N,) or (N, J), a constant () or (J,), with NaN for what is
        missing; names of the joints, or None if not found; remarks about what was assumed.
    """
    fields: dict[str, Floats] = {}
    remarks: list[str] = []
    joints: list[str] | None = list(names.joints) or None
    places = dict.fromkeys([path, *(source.file_of(path) for source in names.sources.values())])
    for place in places:
        sources = {name: one for name, one in names.sources.items() if one.file_of(path) == place}
        is_log_file = place == path
        raw = files.read_file(place, partial(_choose_columns, is_log_file, sources))
        remarks += raw.remarks
        if is_log_file and joints is None and JOINT_NAMES_FIELD in raw.arrays:
            joints = [str(name).strip() for name in np.ravel(raw.arrays[JOINT_NAMES_FIELD])]
        for name, source in sources.items():
            if source.value is not None:
                fields[name] = np.asarray(source.value, dtype=float)
            elif source.columns:
                columns, own = _mapped_columns(place, name, source.columns, raw, joints)
                fields[name] = _stack_columns(place, name, columns, raw, source.scale, remarks)
                joints = own if own and name == "q" else joints
        if is_log_file:
            joints = _add_unmapped(place, raw, names, fields, joints, remarks)
    if names.joints and joints and set(map(joint_name, names.joints)) != set(map(joint_name, joints)):
        raise LogError(
            f"{path}: joint_names: found {format_names(names.joints)} in the map file, but the columns of q are of "
            f"{format_names(joints)}; expected these names, or a list of columns for each field, such as "
            "q: [column_1, column_2]"
        )
    return fields, joints, remarks


def _choose_columns(
    is_log_file: bool, sources: Mapping[str, Source], available: Sequence[str]
) -> dict[str, str]:
    """Select the columns that are needed, each with its field.

    Fields without an entry in the map file are read from the log's own file only.
    """
    chosen: dict[str, str] = {}
    for field, source in sources.items():
        for column in source.columns:
            chosen |= {name: field for name in available if name == column or name.startswith(f"{column}/")}
    if is_log_file:
        for field, columns in _unmapped_columns(available, sources).items():
            chosen |= {name: field for name in columns.values() if name not in chosen}
        chosen |= {JOINT_NAMES_FIELD: JOINT_NAMES_FIELD} if JOINT_NAMES_FIELD in available else {}
    return chosen


def _unmapped_columns(available: Sequence[str], sources: Mapping[str, Source]) -> dict[str, dict[str, str]]:
    """Columns by field and joint, for fields without an entry; columns of an entry are left out."""
    used = {column for one in sources.values() if one.file is None for column in one.columns}
    free = [name for name in available if name not in used and name.partition("/")[0] not in used]
    return {field: columns for field, columns in resolve_columns(free).items() if field not in sources}


def _add_unmapped(
    path: Path,
    raw: RawArrays,
    names: ColumnMap,
    fields: dict[str, Floats],
    joints: list[str] | None,
    remarks: list[str],
) -> list[str] | None:
    """Add the fields without an entry, by own name or alias; return the names of the joints."""
    used = {column for one in names.sources.values() if one.file is None for column in one.columns}
    found = _unmapped_columns([*raw.arrays, *raw.others], names.sources)
    for field, columns in found.items():
        column = next(iter(columns.values()))
        own = [joint for joint in columns if joint != ALL_JOINTS]
        if column.partition("/")[0] != field:
            remarks.append(f"{field}: read from {format_names([repr(name) for name in columns.values()])}")
        if own:
            joints, ordered = _in_order(path, field, own, joints)
            columns = {joint: columns[joint] for joint in ordered}
        fields[field] = _stack_columns(path, field, list(columns.values()), raw, None, remarks, own != [])
        used |= set(columns.values())
    others = [
        name
        for name in (*raw.others, *raw.arrays)
        if name and name != JOINT_NAMES_FIELD and not _is_used(name, used)
    ]
    if others:
        remarks.append(f"{format_names(others)}{UNUSED}")
    return joints


def _is_used(name: str, used: Collection[str]) -> bool:
    """Whether a column, or the group it belongs to, is used."""
    return name in used or name.partition("/")[0] in used


def _in_order(
    path: Path, field: str, own: list[str], joints: list[str] | None
) -> tuple[list[str], list[str]]:
    """The log's joints given those of a field's columns, and the columns in the log's order."""
    if joints and sorted(own) == sorted(joints):
        return joints, joints
    if joints and field != "q":
        raise LogError(
            f"{path}: {field}: found columns of {format_names(own)}, expected those of q: {format_names(joints)}"
        )
    return (own if field == "q" or joints is None else joints), own


def _mapped_columns(
    path: Path, field: str, columns: tuple[str, ...], raw: RawArrays, joints: list[str] | None
) -> tuple[list[str], list[str] | None]:
    """The columns of a map's entry, and their joints: `positions` may mean `positions/knee`."""
    if len(columns) == 1 and columns[0] not in raw.arrays:
        of_joints = {name.partition("/")[2]: name for name in raw.arrays if name.startswith(f"{columns[0]}/")}
        if of_joints:
            _, ordered = _in_order(path, field, list(of_joints), joints)
            return [of_joints[joint] for joint in ordered], ordered
    for name in columns:
        if name not in raw.arrays:
            there = [*raw.arrays, *raw.others]
            near = "".join(f" (did you mean '{one}'?)" for one in get_close_matches(name, there, 1))
            raise LogError(f"{path}: {field}: no '{name}' in it{near}, found {format_names(there, 12)}")
    return list(columns), None


def _stack_columns(
    path: Path,
    field: str,
    columns: Sequence[str],
    raw: RawArrays,
    scale: float | list[float] | None,
    remarks: list[str],
    of_joints: bool = False,
) -> Floats:
    """Stack columns to one array in SI units; add a remark if the file states another unit."""
    factors = [_unit_factor(path, name, raw.units.get(name), scale) for name in columns]
    parts = [raw.arrays[name] * factor for name, factor in zip(columns, factors, strict=True)]
    converted = {raw.units[name] for name, factor in zip(columns, factors, strict=True) if factor != 1.0}
    if converted:
        remarks.append(f"{field}: converted from {format_names(sorted(converted))}, the unit in the file")
    values = np.stack(parts, 1) if len(columns) > 1 or of_joints else parts[0]
    if scale is not None:
        values = values * np.asarray(scale)
    measured = values[:, ~np.isnan(values).all(axis=0)] if values.ndim == 2 else values
    if values.ndim and len(values) and not count_whole_rows(measured):
        raise LogError(
            f"{path}: {field}: no row holds a number for each joint, {len(values)} rows are not finite"
        )
    return values


def count_whole_rows(values: Floats) -> int:
    """Count the rows up to the last one without a missing value.

    Args:
        values: (N,) or (N, J) values.

    Returns:
        The number of rows; 0 if a value is missing in each, or if there is no joint.
    """
    if not values.size:
        return 0
    missing = np.isnan(values)
    whole = np.flatnonzero(~(missing if missing.ndim == 1 else missing.any(axis=1)))
    return int(whole[-1]) + 1 if whole.size else 0


def _unit_factor(path: Path, column: str, unit: str | None, scale: Any) -> float:
    """Factor to SI from the unit that the file states; 1 if the map gives a scale."""
    if unit is None or scale is not None:
        return 1.0
    found = si_factor(unit)
    if found is None:
        raise LogError(
            f"{path}: {column}: the unit '{unit}' is unknown, expected s, rad, N m or the like; --columns gives its scale"
        )
    return found
