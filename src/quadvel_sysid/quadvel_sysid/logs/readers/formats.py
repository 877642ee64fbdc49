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

_FLATTEN = (
    "n = lambda v: isinstance(v, dict) or isinstance(v, list) and any(isinstance(r, dict) for r in v[:1]); "
    "f = lambda v: f({k: [r.get(k, numpy.nan) for r in v] for k in v[0]}) if isinstance(v, (list, tuple)) else "
    "{**max((f(w) for w in dict(v).values() if n(w)), key=len, default={}), "
    "**{str(k): w for k, w in dict(v).items() if not n(w)}}"
)
"""Program that takes the arrays of the largest dict in nested dicts and lists of dicts, and those above it."""
_LOADED = {
    **dict.fromkeys((".pt", ".pth"), ("torch", "torch.load('{name}', map_location='cpu', weights_only=False)")),
    **dict.fromkeys((".pkl", ".pickle"), ("pickle", "pickle.load(open('{name}', 'rb'))")),
    ".joblib": ("joblib", "joblib.load('{name}')"),
    ".npy": ("numpy", "numpy.load('{name}', allow_pickle=True).tolist()"),
    ".npz": (
        "numpy",
        "{k: v.tolist() if v.dtype == object else v for k, v in numpy.load('{name}', allow_pickle=True).items()}",
    ),
}  # fmt: skip
"""By suffix: the module that unpickles a file, and the expression that does it."""
_PANDAS = "python -c \"import pandas; pandas.{reader}.to_csv('log.csv', index=False)\""
CONVERSIONS: Mapping[str, str] = {
    **dict.fromkeys((".xlsx", ".xls", ".ods"), _PANDAS.replace("{reader}", "read_excel('{name}')")),
    **dict.fromkeys((".feather", ".arrow"), _PANDAS.replace("{reader}", "read_feather('{name}')")),
    **dict.fromkeys((".jsonl", ".ndjson"), _PANDAS.replace("{reader}", "read_json('{name}', lines=True)")),
    **dict.fromkeys((".zip", ".xz", ".bz2"), "unpack it"),
    **dict.fromkeys((".zst", ".zstd"), "zstd -d '{name}' -o '{stem}'"),
}  # fmt: skip
"""By suffix: a command that converts a file that is not read."""


def unreadable_reason(path: Path, known: Collection[str]) -> str:
    """Explain in one sentence why files of this suffix are not read.

    Args:
        path: The file.
        known: Suffixes that are read.

    Returns:
        The sentence, with a command that converts the file if there is one.
    """
    suffix = path.suffix.lower()
    if suffix in _LOADED:
        return f"{path}: the suffix is '{path.suffix}': it is {unpickled(path)}"
    if suffix in CONVERSIONS:
        command = CONVERSIONS[suffix].replace("{name}", path.name).replace("{stem}", path.stem)
        return f"{path}: the suffix is '{path.suffix}': nothing here reads it; to convert it: {command}"
    listed = ", ".join((".mcap", ".db3", ".bag", *known))
    return f"{path}: the suffix is '{path.suffix}', expected {listed}, or a folder of rosbag2 or LeRobot"


def unpickled(path: Path) -> str:
    """Explain why a pickle is not read, with a command that converts it.

    Args:
        path: The file, with a suffix of PyTorch, pickle, joblib or NumPy.

    Returns:
        The end of a sentence. The command writes the archive `log.npz`, or `log_arrays.npz` if the
        file itself has that name.
    """
    module, load = _LOADED[path.suffix.lower()]
    archive = "log_arrays.npz" if path.name == "log.npz" else "log.npz"
    program = (
        f"import {', '.join(sorted({'numpy', module}))}; {_FLATTEN}; numpy.savez('{archive}', **f({load}))"
    )
    command = f'python -c "{program}"'.replace("{name}", path.name)
    return (
        "a pickle, which may run programs and is not read; "
        f"if you trust it, and it holds dicts of arrays or a list of dicts: {command}"
    )


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
