"""Common parts of the MATLAB, HDF5 and Parquet readers; why other formats are not read."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from ..log import LogError
from .raw import ColumnChooser, RawArrays, as_numbers, check_size, check_type

MAX_GROUPS = 1000
"""Structs or groups of a file that are searched for a log."""

_TORCH = (
    "python -c \"import numpy, torch; numpy.savez('log.npz', "
    "**{k: numpy.asarray(v) for k, v in torch.load('{name}', weights_only=True).items()})\""
)
_PICKLE = "python -c \"import numpy, pickle; numpy.savez('log.npz', **pickle.load(open('{name}', 'rb')))\""
_JOBLIB = "python -c \"import joblib, numpy; numpy.savez('log.npz', **joblib.load('{name}'))\""
_PANDAS = "python -c \"import pandas; pandas.{reader}.to_csv('log.csv', index=False)\""
_UNPICKLED = "it is a pickle, which may run programs and is not read; if you trust it: {command}"
_CONVERTED = "nothing here reads it; to convert it: {command}"
CONVERSIONS: Mapping[str, tuple[str, str]] = {
    **dict.fromkeys((".pt", ".pth"), (_UNPICKLED, _TORCH)),
    **dict.fromkeys((".pkl", ".pickle"), (_UNPICKLED, _PICKLE)),
    ".joblib": (_UNPICKLED, _JOBLIB),
    **dict.fromkeys((".xlsx", ".xls", ".ods"), (_CONVERTED, _PANDAS.replace("{reader}", "read_excel('{name}')"))),
    **dict.fromkeys((".feather", ".arrow"), (_CONVERTED, _PANDAS.replace("{reader}", "read_feather('{name}')"))),
    **dict.fromkeys((".jsonl", ".ndjson"), (_CONVERTED, _PANDAS.replace("{reader}", "read_json('{name}', lines=True)"))),
    **dict.fromkeys((".zip", ".xz", ".bz2"), (_CONVERTED, "unpack it")),
    **dict.fromkeys((".zst", ".zstd"), (_CONVERTED, "zstd -d '{name}' -o '{stem}'")),
}  # fmt: skip
"""By suffix: why a file is not read, and a command that converts it."""


def unreadable_reason(path: Path, known: Collection[str]) -> str:
    """Explain in one sentence why files of this suffix are not read.

    Args:
        path: The file.
        known: Suffixes that are read.

    Returns:
        The sentence, with a command that converts the file if there is one.
    """
    reason, command = CONVERSIONS.get(path.suffix.lower(), ("", ""))
    command = command.replace("{name}", path.name).replace("{stem}", path.stem)
    if reason:
        return f"{path}: the suffix is '{path.suffix}': {reason.format(command=command)}"
    listed = ", ".join((".mcap", ".db3", ".bag", *known))
    return f"{path}: the suffix is '{path.suffix}', expected {listed}, or a folder of rosbag2 or LeRobot"


def import_reader(path: Path, name: str) -> Any:
    """Import a module of the optional dependency group `formats`.

    Args:
        path: The file to be read, for the error message.
        name: Name of the module.

    Returns:
        The module.

    Raises:
        LogError: It is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        what = f"needs {package}, which is not installed: pip install 'quadvel-core[formats]'"
        raise LogError(f"{path}: reading {path.suffix or 'it'} {what}") from None


@attrs.frozen(eq=False)
class LazyArray:
    """An array in a file that is read on demand.

    Attributes:
        shape: Its shape.
        dtype: Its dtype.
        read: Function that reads it.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    read: Callable[[], Any]

    @classmethod
    def loaded(cls, values: Any) -> LazyArray:
        """Wrap an array that is in memory.

        Args:
            values: The array.

        Returns:
            The wrapper.
        """
        return cls(values.shape, values.dtype, lambda: values)


def select_arrays(path: Path, arrays: Mapping[str, LazyArray], choose: ColumnChooser) -> RawArrays:
    """Find the struct or group that holds the log, and read its fields.

    Args:
        path: The file, for error messages.
        arrays: Arrays by path inside the file.
        choose: Selects the arrays to read.

    Returns:
        The selected arrays.

    Raises:
        LogError: An array has the wrong type, or the log is too large.
    """
    folder = _best_folder(list(arrays), choose)
    there = {name.removeprefix(folder): array for name, array in arrays.items() if name.startswith(folder)}
    chosen = choose(list(there))
    for name, field in chosen.items():
        check_type(path, name, there[name].dtype, field)
    check_size(path, {name: there[name].shape for name in chosen})
    total = sum(math.prod(there[name].shape) for name in chosen)
    read = {name: as_numbers(_squeezed(there[name].read()), field, total) for name, field in chosen.items()}
    return RawArrays(read, tuple(name for name in arrays if name.removeprefix(folder) not in read))


def _squeezed(values: Any) -> Any:
    """Remove axes of length 1, which MATLAB gives to every vector."""
    return np.squeeze(np.asarray(values))


def _best_folder(names: Sequence[str], choose: ColumnChooser) -> str:
    """The struct or group with most fields of a log, with a trailing slash; "" for the file itself."""
    parents = {"", *(name[: at + 1] for name in names for at, letter in enumerate(name) if letter == "/")}

    def fields(folder: str) -> int:
        return len(
            set(choose([name.removeprefix(folder) for name in names if name.startswith(folder)]).values())
        )

    return max(sorted(parents, key=lambda one: (one.count("/"), one))[:MAX_GROUPS], key=fields)
