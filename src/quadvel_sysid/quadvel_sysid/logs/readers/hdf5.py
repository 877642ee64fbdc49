"""Reader of HDF5 files, among them MAT files of version 7.3. It follows no link to another file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..log import LogError
from .formats import LazyArray, import_reader, select_arrays
from .names import JOINT_NAMES_FIELD
from .raw import MAX_VALUES, ColumnChooser, RawArrays

MAGIC = b"\x89HDF\r\n\x1a\n"
"""First bytes of an HDF5 file."""
MAX_DEPTH = 20
"""Levels of nested groups."""


def read_hdf5(path: Path, choose: ColumnChooser) -> RawArrays:
    """Read data sets and columns of tables.

    Args:
        path: The file.
        choose: Selects the arrays to read.

    Returns:
        The selected arrays.

    Raises:
        LogError: The file is damaged, too large, or written by pandas.
    """
    h5py = import_reader(path, "h5py")
    try:
        with h5py.File(path, "r", locking=False) as file:
            if any("pandas_type" in group.attrs for group in file.values()):
                command = (
                    f"python -c \"import pandas; pandas.read_hdf('{path.name}').to_parquet('log.parquet')\""
                )
                raise LogError(
                    f"{path}: is pandas' own kind of HDF5, expected plain data sets; to convert it: {command}"
                )
            return select_arrays(path, dict(_arrays(path, h5py, file, "")), choose)
    except LogError:
        raise
    except Exception as error:  # a broken file fails anywhere in the library
        raise LogError(f"{path}: no whole HDF5 file: {' '.join(str(error).split())[:200]}") from None


def _arrays(path: Path, h5py: Any, group: Any, above: str) -> Iterator[tuple[str, LazyArray]]:
    """Yield the data sets in a group and in its subgroups, by path."""
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink) or name.startswith("#"):
            continue
        child, place = group[name], f"{above}{name}"
        if isinstance(child, h5py.Group) and place.count("/") < MAX_DEPTH:
            yield from _arrays(path, h5py, child, f"{place}/")
        elif isinstance(child, h5py.Dataset) and not child.is_virtual and not child.external:
            if child.chunks and math.prod(child.chunks) > MAX_VALUES:
                raise LogError(
                    f"{path}: {place}: found chunks of {child.chunks}, expected {MAX_VALUES} values at most"
                )
            yield from _stored(h5py, child, place)


def _stored(h5py: Any, data: Any, place: str) -> Iterator[tuple[str, LazyArray]]:
    """Yield a data set as one array, or a table as one array for each column."""
    kind = data.attrs.get("MATLAB_class")
    if data.dtype.names is not None:
        for name in data.dtype.names:
            column = data.dtype[name]
            yield (
                f"{place}/{name}",
                LazyArray((*data.shape, *column.shape), column.base, partial(data.__getitem__, name)),
            )
    elif kind == b"cell" and place.endswith(JOINT_NAMES_FIELD):
        yield place, LazyArray.loaded(np.array([_decode(data.file[one]) for one in np.ravel(data[()])]))
    elif h5py.check_string_dtype(data.dtype) is not None:
        yield place, LazyArray(data.shape, np.dtype("U1"), lambda: np.asarray(data.asstr()[()], dtype=str))
    elif kind is not None:  # MATLAB writes the axes in reverse
        yield place, LazyArray(data.shape[::-1], data.dtype, lambda: np.transpose(data[()]))
    else:
        yield place, LazyArray(data.shape, data.dtype, lambda: data[()])


def _decode(data: Any) -> str:
    """Text of a MATLAB character array."""
    return "".join(map(chr, np.ravel(data[()])[:200]))
