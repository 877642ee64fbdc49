"""Reader of Parquet files: one column for each field or joint; a cell may hold a list."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..log import LogError
from .formats import import_reader
from .raw import ColumnChooser, RawArrays, as_numbers, check_size, check_type

BATCH_ROWS = 10_000
"""Rows that are read together."""


def read_parquet(path: Path, choose: ColumnChooser) -> RawArrays:
    """Read the selected columns.

    Args:
        path: The file.
        choose: Selects the columns to read.

    Returns:
        The selected columns.

    Raises:
        LogError: The file is damaged or too large, or lists differ in length.
    """
    parquet = import_reader(path, "pyarrow.parquet")
    try:
        with parquet.ParquetFile(path) as file:
            return _read(path, file, choose)
    except LogError:
        raise
    except Exception as error:  # a broken file fails anywhere in the library
        raise LogError(f"{path}: no whole Parquet file: {' '.join(str(error).split())[:200]}") from None


def _read(path: Path, file: Any, choose: ColumnChooser) -> RawArrays:
    """Read the selected columns of an open file, batch by batch."""
    names = file.schema_arrow.names
    chosen = choose(names)
    check_size(path, _value_counts(file.metadata, chosen))
    parts: dict[str, list[Any]] = {name: [] for name in chosen}
    for batch in file.iter_batches(BATCH_ROWS, columns=list(chosen)) if chosen else ():
        for name, field in chosen.items():
            part = _column(path, name, batch.column(name))
            check_type(path, name, part.dtype, field)
            parts[name].append(part)
    total = sum(part.size for those in parts.values() for part in those)
    try:
        arrays = {
            name: as_numbers(np.concatenate(those), chosen[name], total)
            for name, those in parts.items()
            if those
        }
    except ValueError:
        raise LogError(
            f"{path}: {', '.join(chosen)}: found lists of unlike length, expected a number for each joint"
        ) from None
    return RawArrays(arrays, tuple(name for name in names if name not in arrays))


def _value_counts(metadata: Any, chosen: Mapping[str, str]) -> dict[str, tuple[int, ...]]:
    """Number of values of each chosen column, as the metadata declares."""
    count: dict[str, int] = dict.fromkeys(chosen, 0)
    for group in range(metadata.num_row_groups):
        row_group = metadata.row_group(group)
        for k in range(row_group.num_columns):
            column = row_group.column(k)
            name = next((one for one in chosen if f"{column.path_in_schema}.".startswith(f"{one}.")), None)
            if name is not None:
                count[name] += column.num_values
    return {name: (values,) for name, values in count.items()}


def _column(path: Path, name: str, column: Any) -> Any:
    """One column of a batch; a missing number becomes NaN."""
    if not str(column.type).startswith(("list", "fixed_size_list", "large_list")):
        return column.to_numpy(zero_copy_only=False)
    rows = len(column)
    values = column.flatten().to_numpy(zero_copy_only=False)
    if column.null_count or (rows and values.size % rows) or len(set(column.value_lengths().to_pylist())) > 1:
        raise LogError(f"{path}: {name}: found lists of unlike length, expected a number for each joint")
    return values.reshape(rows, -1)
