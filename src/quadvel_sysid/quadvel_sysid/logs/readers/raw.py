"""Named arrays as the readers return them, and limits on their size and type."""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, cast

import attrs
import numpy as np
from numpy.typing import DTypeLike

from ..log import LogError
from .names import JOINT_NAMES_FIELD, TIME_FIELDS

MAX_DOUBLE_VALUES = 16_000_000
"""Values (128 MB in double precision) above which a log is kept in single precision."""
MAX_VALUES = 120_000_000
"""Values of a log: 20 minutes of 12 joints at 1 kHz with 8 quantities."""
MAX_TEXT_CHARS = 3_000_000_000
"""Characters of a table after unpacking: some 25 for each of `MAX_VALUES`."""
MAX_LINE_CHARS = 1 << 20
"""Characters of a line of text, or of a text that a log needs."""

ColumnChooser = Callable[[Sequence[str]], Mapping[str, str]]
"""Maps all names in a file to those that are needed, each with its field."""


@attrs.frozen
class RawArrays:
    """Arrays read from a file, before they are mapped to fields.

    Attributes:
        arrays: The selected arrays by name, (N,), (N, J) or ().
        others: Names of all other arrays.
        units: Unit of each array, if the file states it.
        remarks: What the reader assumed, one sentence each.
    """

    arrays: Mapping[str, Any]
    others: tuple[str, ...] = ()
    units: Mapping[str, str] = attrs.field(factory=dict)
    remarks: tuple[str, ...] = ()


def open_bytes(path: Path) -> IO[bytes]:
    """Open a file, unpacked if its name ends with .gz.

    Args:
        path: The file.

    Returns:
        A binary file object.
    """
    return cast(IO[bytes], gzip.open(path, "rb")) if path.suffix == ".gz" else path.open("rb")


def storage_dtype(values: int) -> DTypeLike:
    """Choose the precision in which a log is kept.

    Args:
        values: Number of values of the log.

    Returns:
        float64, or float32 above `MAX_DOUBLE_VALUES`.
    """
    return np.float64 if values <= MAX_DOUBLE_VALUES else np.float32


def field_dtype(field: str, values: int) -> DTypeLike:
    """Choose the precision of one field; times are always in double precision.

    Args:
        field: Name of the field.
        values: Number of values of the log.

    Returns:
        float64 or float32.
    """
    return np.float64 if field in TIME_FIELDS else storage_dtype(values)


def check_size(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Check that arrays are no larger than a log may be.

    Args:
        path: The file, for the error message.
        shapes: Shape of each array.

    Raises:
        LogError: They hold more than `MAX_VALUES` values.
    """
    size = {name: math.prod(shape) for name, shape in shapes.items()}
    total = sum(size.values())
    if total > MAX_VALUES:
        largest = max(size, key=lambda name: size[name])
        raise LogError(
            f"{path}: {largest}: found shape {shapes[largest]}, {total} values with the other fields, "
            f"expected {MAX_VALUES} at most; cut the log"
        )


def check_type(path: Path, name: str, dtype: np.dtype[Any], field: str) -> None:
    """Check that an array holds numbers, truth values or times, or text if the field is text.

    Args:
        path: The file, for the error message.
        name: Name of the array.
        dtype: Its dtype.
        field: Field that it holds.

    Raises:
        LogError: It holds something else.
    """
    kinds = "US" if field == JOINT_NAMES_FIELD else "biufM" if field in TIME_FIELDS else "biuf"
    if dtype.kind not in kinds:
        expected = "text" if field == JOINT_NAMES_FIELD else "numbers"
        raise LogError(f"{path}: {name}: found the type {dtype}, expected {expected}")


def as_numbers(values: Any, field: str, total: int) -> Any:
    """Convert an array to the precision of its log; dates become seconds since 1970.

    Args:
        values: The array; text is returned unchanged.
        field: Field that it holds.
        total: Number of values of the log.

    Returns:
        The converted array.
    """
    values = np.asarray(values)
    if values.dtype.kind in "US":
        return values
    if values.dtype.kind == "M":
        missing, values = np.isnat(values), values.astype("datetime64[ns]").astype(np.int64) * 1e-9
        values[missing] = np.nan
    return values.astype(field_dtype(field, total), copy=False)
