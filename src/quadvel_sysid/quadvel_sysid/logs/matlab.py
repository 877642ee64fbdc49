"""MAT files: variables that MATLAB's `save` writes, up to version 7 and in version 7.3. No MATLAB object is made."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from . import hdf5
from .formats import Stored, selected
from .log import LogError
from .raw import LARGEST, Choose, Raw, check_size

LARGEST_UNPACKED = 8 * LARGEST
"""Bytes: LARGEST values in double precision."""
COMPRESSED = 15
"""Kind of an element of a MAT file, miCOMPRESSED."""


def read(path: Path, choose: Choose) -> Raw:
    """Variables, or the fields of a struct, that MATLAB's `save` writes; version 7.3 is HDF5 by another name."""
    with path.open("rb") as file:
        start = file.read(520)
    if hdf5.MAGIC in (start[:8], start[512:520]):
        return hdf5.read(path, choose)
    _check_unpacked(path)
    try:
        shapes = {name: shape for name, shape, _ in scipy.io.whosmat(path)}
        check_size(path, shapes)
        content = scipy.io.loadmat(path, simplify_cells=True)
    except LogError:
        raise
    except Exception as error:  # a broken file fails anywhere in the reader
        raise LogError(f"{path}: no whole MAT file: {' '.join(str(error).split())[:200]}") from None
    arrays = dict(_flat({name: value for name, value in content.items() if not name.startswith("__")}))
    if not arrays:
        raise LogError(
            f"{path}: found no arrays but {', '.join(shapes) or 'nothing'}, expected numbers or a struct of them; a table or "
            "a timeseries has to be taken apart: save('log.mat', 't', 'q', 'q_des')"
        )
    return selected(path, arrays, choose)


def _check_unpacked(path: Path) -> None:
    """Raises LogError where the packed variables of a MAT file are larger than a log may be; they are counted, not kept."""
    total = 0
    with path.open("rb") as file:
        file.seek(128)
        while len(tag := file.read(8)) == 8:
            kind, size = np.frombuffer(tag, "<u4").tolist()
            unpack, end = zlib.decompressobj(), file.tell() + size
            if kind != COMPRESSED:
                file.seek(end)
                continue
            while file.tell() < end and (packed := file.read(min(1 << 16, end - file.tell()))):
                while packed and total <= LARGEST_UNPACKED:
                    total += len(unpack.decompress(packed, 1 << 20))
                    packed = unpack.unconsumed_tail
            if total > LARGEST_UNPACKED:
                raise LogError(
                    f"{path}: more than {LARGEST_UNPACKED} bytes unpacked, expected fewer; cut the log"
                )


def _flat(content: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Stored]]:
    """Arrays of numbers or text in nested dicts, by their path."""
    for name, value in content.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{name}/")
            continue
        array = np.asarray(value)
        if array.dtype == object and all(isinstance(one, str) for one in array.flat):
            array = array.astype(str)
        if array.dtype.kind in "biufUS":
            yield f"{above}{name}", Stored.of(array)
