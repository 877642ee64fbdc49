"""Reader of MAT files as MATLAB's `save` writes them, up to version 7 and in version 7.3."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from ..log import LogError
from . import hdf5
from .formats import LazyArray, select_arrays
from .raw import MAX_VALUES, ColumnChooser, RawArrays, check_size

MAX_UNPACKED_BYTES = 8 * MAX_VALUES
"""Bytes: `MAX_VALUES` values in double precision."""
MI_COMPRESSED = 15
"""Type of a compressed element of a MAT file, miCOMPRESSED."""


def read_mat(path: Path, choose: ColumnChooser) -> RawArrays:
    """Read variables or the fields of a struct; a file of version 7.3 is read as HDF5.

    Args:
        path: The file.
        choose: Selects the variables to read.

    Returns:
        The selected arrays.

    Raises:
        LogError: The file is damaged, too large, or holds no arrays.
    """
    with path.open("rb") as file:
        start = file.read(520)
    if hdf5.MAGIC in (start[:8], start[512:520]):
        return hdf5.read_hdf5(path, choose)
    _check_unpacked(path)
    try:
        shapes = {name: shape for name, shape, _ in scipy.io.whosmat(path)}
        check_size(path, shapes)
        content = scipy.io.loadmat(path, simplify_cells=True)
    except LogError:
        raise
    except Exception as error:  # a broken file fails anywhere in the reader
        raise LogError(f"{path}: no whole MAT file: {' '.join(str(error).split())[:200]}") from None
    arrays = dict(_flatten({name: value for name, value in content.items() if not name.startswith("__")}))
    if not arrays:
        raise LogError(
            f"{path}: found no arrays but {', '.join(shapes) or 'nothing'}, expected numbers or a struct of them; a table or "
            "a timeseries has to be split: save('log.mat', 't', 'q', 'q_des')"
        )
    return select_arrays(path, arrays, choose)


def _check_unpacked(path: Path) -> None:
    """Raise LogError if the variables unpack to more than `MAX_UNPACKED_BYTES`; none is kept."""
    total = 0
    with path.open("rb") as file:
        file.seek(128)
        while len(tag := file.read(8)) == 8:
            kind, size = np.frombuffer(tag, "<u4").tolist()
            unpack, end = zlib.decompressobj(), file.tell() + size
            if kind != MI_COMPRESSED:
                file.seek(end)
                continue
            while file.tell() < end and (packed := file.read(min(1 << 16, end - file.tell()))):
                while packed and total <= MAX_UNPACKED_BYTES:
                    total += len(unpack.decompress(packed, 1 << 20))
                    packed = unpack.unconsumed_tail
            if total > MAX_UNPACKED_BYTES:
                raise LogError(
                    f"{path}: more than {MAX_UNPACKED_BYTES} bytes unpacked, expected fewer; cut the log"
                )


def _flatten(content: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, LazyArray]]:
    """Yield arrays of numbers or text in nested dicts, by path."""
    for name, value in content.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{above}{name}/")
            continue
        array = np.asarray(value)
        if array.dtype == object and all(isinstance(one, str) for one in array.flat):
            array = array.astype(str)
        if array.dtype.kind in "biufUS":
            yield f"{above}{name}", LazyArray.loaded(array)
