"""Named arrays as a file holds them, and how much of it a log may hold; the readers of all formats fill `Raw`."""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, cast

import attrs
import numpy as np
from numpy.typing import DTypeLike

from .log import LogError
from .names import NAMES, TIMES

LONG = 16_000_000
"""Values (128 MB in double precision) above which a log is kept in single precision."""
LARGEST = 120_000_000
"""Values: 20 minutes of 12 joints at 1 kHz with 8 quantities."""
LARGEST_TEXT = 3_000_000_000
"""Characters of a table, also of one that is packed: some 25 for each of LARGEST values."""
LONGEST_LINE = 1 << 20
"""Characters of a line of text, or of a text that a log needs."""

Choose = Callable[[Sequence[str]], Mapping[str, str]]
"""Of all names in a file those that are needed, each with the field that it holds."""


@attrs.frozen
class Raw:
    """The arrays of a file that were asked for, (N,), (N, J) or (), and the names of all others.

    units: by array, where the file states one. remarks: what was assumed while reading.
    """

    arrays: Mapping[str, Any]
    others: tuple[str, ...] = ()
    units: Mapping[str, str] = attrs.field(factory=dict)
    remarks: tuple[str, ...] = ()


def opened(path: Path) -> IO[bytes]:
    """The bytes of a file, unpacked where its name ends in .gz."""
    return cast(IO[bytes], gzip.open(path, "rb")) if path.suffix == ".gz" else path.open("rb")


def precision(values: int) -> DTypeLike:
    """The type that a log of so many values is kept in."""
    return np.float64 if values <= LONG else np.float32


def type_of(field: str, values: int) -> DTypeLike:
    """The same for one field: times are kept in double precision, however long the log is."""
    return np.float64 if field in TIMES else precision(values)


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


def check_type(path: Path, name: str, dtype: np.dtype[Any], field: str) -> None:
    """Raises LogError where an array holds anything but numbers, truth values or times, or text where a field is text."""
    kinds = "US" if field == NAMES else "biufM" if field in TIMES else "biuf"
    if dtype.kind not in kinds:
        expected = "text" if field == NAMES else "numbers"
        raise LogError(f"{path}: {name}: found the type {dtype}, expected {expected}")


def numbers(values: Any, field: str, total: int) -> Any:
    """The array in the precision of a log of `total` values; dates become seconds since 1970."""
    values = np.asarray(values)
    if values.dtype.kind in "US":
        return values
    if values.dtype.kind == "M":
        missing, values = np.isnat(values), values.astype("datetime64[ns]").astype(np.int64) * 1e-9
        values[missing] = np.nan
    return values.astype(type_of(field, total), copy=False)
