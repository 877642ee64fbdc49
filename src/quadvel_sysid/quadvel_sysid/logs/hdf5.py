"""HDF5 files, MAT files of version 7.3 among them. No link to another file is followed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .formats import Stored, library, selected
from .log import LogError
from .names import NAMES
from .raw import LARGEST, Choose, Raw

MAGIC = b"\x89HDF\r\n\x1a\n"
DEEPEST = 20
"""Groups within groups."""


def read(path: Path, choose: Choose) -> Raw:
    """The data sets of a log, and the columns of tables. Raises LogError."""
    h5py = library(path, "h5py")
    try:
        with h5py.File(path, "r", locking=False) as file:
            if any("pandas_type" in group.attrs for group in file.values()):
                command = (
                    f"python -c \"import pandas; pandas.read_hdf('{path.name}').to_parquet('log.parquet')\""
                )
                raise LogError(
                    f"{path}: is pandas' own kind of HDF5, expected plain data sets; to convert it: {command}"
                )
            return selected(path, dict(_arrays(path, h5py, file, "")), choose)
    except LogError:
        raise
    except Exception as error:  # a broken file fails anywhere in the library
        raise LogError(f"{path}: no whole HDF5 file: {' '.join(str(error).split())[:200]}") from None


def _arrays(path: Path, h5py: Any, group: Any, above: str) -> Iterator[tuple[str, Stored]]:
    """The data sets in a group and in those below, by their path."""
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink) or name.startswith("#"):
            continue
        child, place = group[name], f"{above}{name}"
        if isinstance(child, h5py.Group) and place.count("/") < DEEPEST:
            yield from _arrays(path, h5py, child, f"{place}/")
        elif isinstance(child, h5py.Dataset) and not child.is_virtual and not child.external:
            if child.chunks and math.prod(child.chunks) > LARGEST:
                raise LogError(
                    f"{path}: {place}: found chunks of {child.chunks}, expected {LARGEST} values at most"
                )
            yield from _stored(h5py, child, place)


def _stored(h5py: Any, data: Any, place: str) -> Iterator[tuple[str, Stored]]:
    """A data set as one array; a table as one for each of its columns."""
    kind = data.attrs.get("MATLAB_class")
    if data.dtype.names is not None:
        for name in data.dtype.names:
            column = data.dtype[name]
            yield (
                f"{place}/{name}",
                Stored((*data.shape, *column.shape), column.base, partial(data.__getitem__, name)),
            )
    elif kind == b"cell" and place.endswith(NAMES):
        yield place, Stored.of(np.array([_characters(data.file[one]) for one in np.ravel(data[()])]))
    elif h5py.check_string_dtype(data.dtype) is not None:
        yield place, Stored(data.shape, np.dtype("U1"), lambda: np.asarray(data.asstr()[()], dtype=str))
    elif kind is not None:  # MATLAB writes the axes in reverse
        yield place, Stored(data.shape[::-1], data.dtype, lambda: np.transpose(data[()]))
    else:
        yield place, Stored(data.shape, data.dtype, lambda: data[()])


def _characters(data: Any) -> str:
    return "".join(map(chr, np.ravel(data[()])[:200]))
