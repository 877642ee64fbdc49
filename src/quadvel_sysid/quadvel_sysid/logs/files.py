"""Named arrays out of NPZ archives, CSV tables and JSON documents, whatever they are called there.

Sizes are looked at before anything is read: an archive may promise more than memory holds. Nothing is unpickled.
"""

from __future__ import annotations

import csv
import gzip
import json
import math
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import IO, Any

import attrs
import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike

from .log import Array, LogError

LONG = 16_000_000
"""Values (128 MB in double precision) above which a log is kept in single precision."""
LARGEST = 120_000_000
"""Values: 20 minutes of 12 joints at 1 kHz with 8 quantities."""
LARGEST_DOCUMENT = 100_000_000
"""Characters of a JSON document, which is read whole."""
LINES = 20_000  # of a table, read at once
LONGEST_LINE = 1 << 20  # characters

Wanted = Callable[[str], bool]
"""Is an array or column of this name needed?"""


@attrs.frozen
class Raw:
    """The arrays of a file that were asked for, (N,), (N, J) or (), and the names of all others."""

    arrays: Mapping[str, Any]
    others: tuple[str, ...]


def read(path: Path, wanted: Wanted) -> Raw:
    """The arrays of the file at `path`, by its suffix; `.gz` behind it says that it is compressed. Raises LogError."""
    suffixes = [suffix for suffix in path.suffixes[-2:] if suffix != ".gz"]
    readers = {".npz": _npz, ".csv": _csv, ".json": _json}
    suffix = suffixes[-1] if suffixes else ""
    if suffix not in readers:
        raise LogError(
            f"{path}: the suffix is '{path.suffix}', expected .mcap, .npz, .csv, .json or a rosbag2 folder"
        )
    try:
        return readers[suffix](path, wanted)
    except (zlib.error, EOFError, gzip.BadGzipFile) as error:
        raise LogError(f"{path}: no whole file: {error or 'it is cut off'}") from None


def precision(values: int) -> DTypeLike:
    """What a log of so many values is kept in."""
    return np.float64 if values <= LONG else np.float32


def of_time(name: str) -> bool:
    """Times are kept in double precision, however long the log is."""
    return name.startswith("t")


def check_size(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raises LogError where arrays of these shapes are more than a log may hold."""
    size = {name: math.prod(shape) for name, shape in shapes.items()}
    total = sum(size.values())
    if total > LARGEST:
        largest = max(size, key=lambda name: size[name])
        raise LogError(
            f"{path}: {largest}: found shape {shapes[largest]}, {total} values with the other fields, "
            f"expected {LARGEST} at most; cut the log"
        )


def _npz(path: Path, wanted: Wanted) -> Raw:
    """An archive as `numpy.savez` writes it."""
    try:
        with zipfile.ZipFile(path) as archive:
            shapes = dict(_headers(path, archive, wanted))
            check_size(path, {name: shape for name, (shape, _) in shapes.items()})
            dtype = precision(sum(math.prod(shape) for shape, _ in shapes.values()))
            names = [one.removesuffix(".npy") for one in archive.namelist()]
            return Raw(
                {name: _array(archive, name, kind, dtype) for name, (_, kind) in shapes.items()},
                tuple(name for name in names if name not in shapes),
            )
    except (zipfile.BadZipFile, EOFError, zlib.error, NotImplementedError) as error:
        if path.stat().st_size == 0:
            raise LogError(f"{path}: the file is empty, expected an NPZ archive") from None
        raise LogError(f"{path}: no whole NPZ archive: {error or 'it is cut off'}") from None


def _headers(
    path: Path, archive: zipfile.ZipFile, wanted: Wanted
) -> Iterator[tuple[str, tuple[tuple[int, ...], np.dtype[Any]]]]:
    """Field, shape and type of the archive's arrays that belong to a log, without reading one."""
    for member in archive.namelist():
        name = member.removesuffix(".npy")
        if member == name or not wanted(name):
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


def _array(archive: zipfile.ZipFile, name: str, kind: np.dtype[Any], dtype: DTypeLike) -> Any:
    with archive.open(f"{name}.npy") as file:
        try:
            values = npy.read_array(file, allow_pickle=False)
        except ValueError as error:
            raise EOFError(f"{name}: {error}") from None
    if kind.kind in "US":
        return values
    return values.astype(np.float64 if of_time(name) else dtype, copy=False)


def _csv(path: Path, wanted: Wanted) -> Raw:
    """A table with names in its first line; cells may hold lists of numbers, those behind the end of a column are empty."""
    with _text(path) as file:
        header = file.readline(LONGEST_LINE)
        if "\0" in header or not header.endswith("\n"):
            raise LogError(
                f"{path}: the first line is no header, expected the columns t, q/FR_hip_joint, ..."
            )
        columns = [cell.strip().strip('"') for cell in header.strip().lstrip("\ufeff").split(",")]
        for column, times in Counter(columns).items():
            if times > 1:
                raise LogError(f"{path}: {column}: the column stands there twice")
        known = [k for k, column in enumerate(columns) if wanted(column)]
        if not known:
            raise LogError(
                f"{path}: t: no such column in the first line ({header.strip()[:60]!r}); expected t, q/FR_hip_joint, ... "
                "with commas between"
            )
        lines = max(1, path.stat().st_size // max(1, 2 * len(columns)))
        dtype = precision(lines * len(known) // 4)  # a number takes about eight characters
        blocks = list(_blocks(path, file, columns, known, dtype))
    if not blocks:
        raise LogError(f"{path}: t: the table has no rows")
    return Raw(
        {columns[k]: np.concatenate([block[i] for block in blocks]) for i, k in enumerate(known)},
        tuple(column for k, column in enumerate(columns) if k not in known),
    )


def _text(path: Path) -> IO[str]:
    if path.suffix == ".gz":
        return gzip.open(path, "rt", encoding="utf-8", errors="replace")
    return path.open(encoding="utf-8", errors="replace")


def _blocks(
    path: Path, file: IO[str], columns: list[str], known: list[int], dtype: DTypeLike
) -> Iterator[list[Array]]:
    """The known columns, some lines of each."""
    kinds = [np.float64 if of_time(columns[k]) else dtype for k in known]
    rows = 0
    while lines := list(islice(iter(lambda: file.readline(LONGEST_LINE), ""), LINES)):
        lines = [line for line in lines if line.strip()]
        if not lines:
            continue
        listed = any("[" in line for line in lines[:3])
        parts = _lists(path, lines, columns, known) if listed else _numbers(path, lines, columns, rows + 2)
        found = parts if listed else [parts[k] for k in known]
        rows += len(lines)
        if rows * sum(max(1, part.size // len(lines)) for part in found) > LARGEST:
            raise LogError(f"{path}: more than {LARGEST} values, expected fewer; cut the log")
        yield [part.astype(kind) for part, kind in zip(found, kinds, strict=True)]


def _numbers(path: Path, lines: list[str], columns: list[str], first: int) -> list[Array]:
    """All columns of lines that hold a number in each cell, or nothing; `first` is the number of the first line."""
    lines = [_cells(line) for line in lines]
    try:
        values = np.loadtxt(lines, delimiter=",", ndmin=2, comments=None)
        if values.shape[1] != len(columns):
            raise ValueError
    except ValueError:
        raise LogError(f"{path}: {_odd_cell(lines, columns, first)}") from None
    return list(values.T)


def _lists(path: Path, lines: list[str], columns: list[str], known: list[int]) -> list[Array]:
    """The known columns of lines whose cells may hold lists of numbers, such as "[0.1, 0.2]"."""
    rows = list(csv.reader(lines))
    found = []
    for k in known:
        try:
            found.append(np.array([json.loads(row[k] or "NaN") for row in rows], dtype=float))
        except (ValueError, TypeError, IndexError, RecursionError):
            raise LogError(
                f"{path}: {columns[k]}: found a cell that is neither a number nor a list of as many numbers as the others"
            ) from None
    return found


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


def _json(path: Path, wanted: Wanted) -> Raw:
    """A document of named lists, or of a list of records, wherever it stands; numbers beside it count for all rows."""
    with _text(path) as file:
        text = file.read(LARGEST_DOCUMENT + 1)
    if len(text) > LARGEST_DOCUMENT:
        raise LogError(f"{path}: more than {LARGEST_DOCUMENT} characters; expected an NPZ archive of so much")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise LogError(f"{path}: no JSON document: {str(error)[:100]}") from None
    named = document if isinstance(document, dict) else {"rows": document}
    columns: dict[str, Any] = {name: value for name, value in named.items() if not _records(value)}
    for value in named.values():
        if _records(value):
            columns |= {name: [row.get(name) for row in value] for name in value[0]}
    arrays: dict[str, Any] = {}
    for name, values in columns.items():
        if wanted(name):
            try:
                arrays[name] = np.array(values, dtype=str if name == "joint_names" else float)
            except (ValueError, TypeError):
                raise LogError(f"{path}: {name}: found what is no number, or rows of unlike length") from None
    check_size(path, {name: values.shape for name, values in arrays.items()})
    return Raw(arrays, tuple(name for name in columns if name not in arrays))


def _records(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(isinstance(row, dict) for row in value)
