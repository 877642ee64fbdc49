"""Readers of NPZ archives and of NPY files of records; headers are checked before unpacking."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from ..log import LogError
from .formats import unpickled
from .names import JOINT_NAMES_FIELD
from .raw import MAX_LINE_CHARS, ColumnChooser, RawArrays, as_numbers, check_size, check_type

MAX_HEADER_CHARS = 10_000
"""Characters of an array's header, as numpy reads them."""

Header = tuple[tuple[int, ...], np.dtype[Any]]
"""Shape and dtype of an array."""
ARCHIVE_ERRORS = (
    zipfile.BadZipFile,
    EOFError,
    zlib.error,
    NotImplementedError,
    RuntimeError,
    OSError,
    OverflowError,
)
"""Exceptions of zipfile for an archive that is truncated, encrypted or packed in an unknown way."""


def read_npz(path: Path, choose: ColumnChooser) -> RawArrays:
    """Read an archive as `numpy.savez` writes it.

    Args:
        path: The file.
        choose: Selects the arrays to read.

    Returns:
        The selected arrays.

    Raises:
        LogError: The archive is truncated or empty, holds pickled objects, or is too large.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            there = [one.removesuffix(".npy") for one in archive.namelist() if one.endswith(".npy")]
            chosen = choose(there)
            others = tuple(name for name in there if name not in chosen)
            remarks = _pickled_remarks(path, archive, others)
            if remarks and not chosen:
                raise LogError(f"{path}: {remarks[0]}")
            headers = {name: _member_header(path, archive, name, field) for name, field in chosen.items()}
            check_size(path, {name: shape for name, (shape, _) in headers.items()})
            total = sum(math.prod(shape) for shape, _ in headers.values())
            arrays = {
                name: as_numbers(_read_member(archive, name), field, total) for name, field in chosen.items()
            }
            return RawArrays(arrays, others, remarks=remarks)
    except ARCHIVE_ERRORS as error:
        if path.stat().st_size == 0:
            raise LogError(f"{path}: the file is empty, expected an NPZ archive") from None
        raise LogError(f"{path}: no whole NPZ archive: {error or 'it is cut off'}") from None


def read_npy(path: Path, choose: ColumnChooser) -> RawArrays:
    """Read an array of records with named fields.

    Args:
        path: The file.
        choose: Selects the fields to read.

    Returns:
        The selected fields.

    Raises:
        LogError: The array has no field names, holds pickled objects, or is too large.
        EOFError: The file is truncated.
    """
    with path.open("rb") as file:
        try:
            shape, dtype = _read_header(file)
        except ValueError as error:
            raise LogError(f"{path}: no NumPy array: {error}") from None
        if dtype.hasobject:
            raise LogError(f"{path}: log: found the type object, {unpickled(path)}")
        if dtype.names is None:
            raise LogError(
                f"{path}: found one array {shape} without names, expected records, or an NPZ archive: "
                "np.savez('log.npz', t=..., q=..., q_des=...)"
            )
        if min(shape, default=0) < 0:
            raise LogError(f"{path}: found shape {shape}, expected no length below 0")
        chosen = choose(dtype.names)
        for name, field in chosen.items():
            check_type(path, name, dtype[name].base, field)
        check_size(path, {name: (*shape, *_record_width(dtype[name])) for name in dtype.names})
        file.seek(0)
        try:
            records = npy.read_array(file, allow_pickle=False)
        except ValueError as error:
            raise EOFError(str(error)) from None
    total = sum(records[name].size for name in chosen)
    arrays = {name: as_numbers(records[name], field, total) for name, field in chosen.items()}
    return RawArrays(arrays, tuple(name for name in dtype.names if name not in chosen))


def _record_width(dtype: np.dtype[Any]) -> tuple[int, ...]:
    """Upper bound on the number of doubles in one record's field, as a shape."""
    return (*dtype.shape, max(1, dtype.base.itemsize // 8))


def _read_header(file: IO[bytes]) -> Header:
    """Read shape and dtype of an array, and nothing behind its header; raises ValueError."""
    start = io.BytesIO(file.read(MAX_HEADER_CHARS + 12))
    version = npy.read_magic(start)
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read_header(start)
    return shape, dtype


def _member_header(path: Path, archive: zipfile.ZipFile, name: str, field: str) -> Header:
    """Read and check the header of an archive's array."""
    with archive.open(f"{name}.npy") as file:
        try:
            shape, dtype = _read_header(file)
        except ValueError as error:
            raise LogError(f"{path}: {name}: no NumPy array: {error}") from None
    if min(shape, default=0) < 0:
        raise LogError(f"{path}: {name}: found shape {shape}, expected no length below 0")
    if dtype.hasobject:
        raise LogError(f"{path}: {name}: found the type object, expected numbers: {unpickled(path)}")
    check_type(path, name, dtype, field)
    if field == JOINT_NAMES_FIELD and math.prod(shape) * dtype.itemsize > MAX_LINE_CHARS:
        raise LogError(f"{path}: {name}: found {shape} names, expected one a joint")
    return shape, dtype


def _pickled_remarks(path: Path, archive: zipfile.ZipFile, names: Sequence[str]) -> tuple[str, ...]:
    """A remark about the first array that holds pickled objects, as `numpy.savez` writes a dict."""
    for name in names[:10]:
        with archive.open(f"{name}.npy") as file:
            try:
                _, dtype = _read_header(file)
            except ValueError:
                continue
        if dtype.hasobject:
            return (f"{name}: found the type object, {unpickled(path)}",)
    return ()


def _read_member(archive: zipfile.ZipFile, name: str) -> Any:
    """Read one array of an archive."""
    with archive.open(f"{name}.npy") as file:
        try:
            return npy.read_array(file, allow_pickle=False)
        except ValueError as error:
            raise EOFError(f"{name}: {error}") from None
