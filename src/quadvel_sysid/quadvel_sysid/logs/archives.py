"""NPZ archives and NPY files of records, whose headers are looked at before any array is unpacked."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from .log import LogError
from .names import NAMES
from .raw import LONGEST_LINE, Choose, Raw, check_size, check_type, numbers

LONGEST_HEADER = 10_000
"""Characters of an array's header, as numpy reads them."""

Header = tuple[tuple[int, ...], np.dtype[Any]]
"""Shape and type of an array."""
BROKEN = (zipfile.BadZipFile, EOFError, zlib.error, NotImplementedError, RuntimeError, OSError, OverflowError)
"""What zipfile raises where an archive is cut off, packed in an unknown way, or encrypted."""
UNPICKLED = "{path}: {name}: found the type object, a pickle, which may run programs and is not read; if you trust it: {command}"

CONVERSION = (
    'python -c "import numpy as np; '
    "np.savez('log.npz', **np.load('{name}', allow_pickle=True){member}.item())\""
)


def read_npz(path: Path, choose: Choose) -> Raw:
    """An archive as `numpy.savez` writes it."""
    try:
        with zipfile.ZipFile(path) as archive:
            there = [one.removesuffix(".npy") for one in archive.namelist() if one.endswith(".npy")]
            chosen = choose(there)
            if not chosen:
                _refuse_objects(path, archive, there)
            headers = {name: _member_header(path, archive, name, field) for name, field in chosen.items()}
            check_size(path, {name: shape for name, (shape, _) in headers.items()})
            total = sum(math.prod(shape) for shape, _ in headers.values())
            arrays = {name: numbers(_member(archive, name), field, total) for name, field in chosen.items()}
            return Raw(arrays, tuple(name for name in there if name not in chosen))
    except BROKEN as error:
        if path.stat().st_size == 0:
            raise LogError(f"{path}: the file is empty, expected an NPZ archive") from None
        raise LogError(f"{path}: no whole NPZ archive: {error or 'it is cut off'}") from None


def read_npy(path: Path, choose: Choose) -> Raw:
    """An array of records, whose fields are named."""
    with path.open("rb") as file:
        try:
            shape, dtype = _header(file)
        except ValueError as error:
            raise LogError(f"{path}: no NumPy array: {error}") from None
        if dtype.hasobject:
            command = CONVERSION.format(name=path.name, member="")
            raise LogError(UNPICKLED.format(path=path, name="log", command=command))
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
        check_size(path, {name: (*shape, *_columns(dtype[name])) for name in dtype.names})
        file.seek(0)
        try:
            records = npy.read_array(file, allow_pickle=False)
        except ValueError as error:
            raise EOFError(str(error)) from None
    total = sum(records[name].size for name in chosen)
    arrays = {name: numbers(records[name], field, total) for name, field in chosen.items()}
    return Raw(arrays, tuple(name for name in dtype.names if name not in chosen))


def _columns(dtype: np.dtype[Any]) -> tuple[int, ...]:
    """How many doubles one record's field is, at most."""
    return (*dtype.shape, max(1, dtype.base.itemsize // 8))


def _header(file: IO[bytes]) -> Header:
    """Shape and type of an array, of which no more than its header is unpacked. Raises ValueError."""
    start = io.BytesIO(file.read(LONGEST_HEADER + 12))
    version = npy.read_magic(start)
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read_header(start)
    return shape, dtype


def _member_header(path: Path, archive: zipfile.ZipFile, name: str, field: str) -> Header:
    """The same of an archive's array that belongs to a log."""
    with archive.open(f"{name}.npy") as file:
        try:
            shape, dtype = _header(file)
        except ValueError as error:
            raise LogError(f"{path}: {name}: no NumPy array: {error}") from None
    if min(shape, default=0) < 0:
        raise LogError(f"{path}: {name}: found shape {shape}, expected no length below 0")
    check_type(path, name, dtype, field)
    if field == NAMES and math.prod(shape) * dtype.itemsize > LONGEST_LINE:
        raise LogError(f"{path}: {name}: found {shape} names, expected one a joint")
    return shape, dtype


def _refuse_objects(path: Path, archive: zipfile.ZipFile, names: list[str]) -> None:
    """Raises LogError where an array holds a pickled dict, as `numpy.savez` makes of one."""
    for name in names[:10]:
        with archive.open(f"{name}.npy") as file:
            try:
                _, dtype = _header(file)
            except ValueError:
                continue
        if dtype.hasobject:
            command = CONVERSION.format(name=path.name, member=f"['{name}']")
            raise LogError(UNPICKLED.format(path=path, name=name, command=command))


def _member(archive: zipfile.ZipFile, name: str) -> Any:
    with archive.open(f"{name}.npy") as file:
        try:
            return npy.read_array(file, allow_pickle=False)
        except ValueError as error:
            raise EOFError(f"{name}: {error}") from None
