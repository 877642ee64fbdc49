"""What readers of MATLAB, HDF5 and Parquet have in common, and why files of other formats are not read."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from .log import LogError
from .raw import Choose, Raw, check_size, check_type, numbers

MOST_GROUPS = 1000
"""Structs or groups of a file among which a log is looked for."""

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
    **dict.fromkeys((".zip", ".zst", ".xz", ".bz2"), (_CONVERTED, "unpack it")),
}  # fmt: skip
"""By suffix: why a file is not read, and the command that makes one of it that is."""


def refusal(path: Path, known: Collection[str]) -> str:
    """Why a file of this suffix is not read, in one sentence."""
    reason, command = CONVERSIONS.get(path.suffix.lower(), ("", ""))
    command = command.replace("{name}", path.name)
    if reason:
        return f"{path}: the suffix is '{path.suffix}': {reason.format(command=command)}"
    listed = ", ".join((".mcap", ".db3", ".bag", *known))
    return f"{path}: the suffix is '{path.suffix}', expected {listed}, or a folder of rosbag2 or LeRobot"


def library(path: Path, name: str) -> Any:
    """A module of the extra `formats`. Raises LogError where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        what = f"needs {package}, which is not installed: pip install 'quadvel[formats]'"
        raise LogError(f"{path}: reading {path.suffix or 'it'} {what}") from None


@attrs.frozen(eq=False)
class Stored:
    """An array that a file holds and that was not read yet."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    read: Callable[[], Any]

    @classmethod
    def of(cls, values: Any) -> Stored:
        """An array that was read already."""
        return cls(values.shape, values.dtype, lambda: values)


def selected(path: Path, arrays: Mapping[str, Stored], choose: Choose) -> Raw:
    """What of named arrays belongs to a log, in whatever struct or group it stands; that is read. Raises LogError."""
    folder = _folder(list(arrays), choose)
    there = {name.removeprefix(folder): array for name, array in arrays.items() if name.startswith(folder)}
    chosen = choose(list(there))
    for name, field in chosen.items():
        check_type(path, name, there[name].dtype, field)
    check_size(path, {name: there[name].shape for name in chosen})
    total = sum(math.prod(there[name].shape) for name in chosen)
    read = {name: numbers(_squeezed(there[name].read()), field, total) for name, field in chosen.items()}
    return Raw(read, tuple(name for name in arrays if name.removeprefix(folder) not in read))


def _squeezed(values: Any) -> Any:
    """Without axes of length 1, which MATLAB gives to every vector; a row of joints stays one."""
    return np.squeeze(np.asarray(values))


def _folder(names: Sequence[str], choose: Choose) -> str:
    """The struct or group that holds most fields of a log, with a slash behind it, or "" for the file itself."""
    parents = {"", *(name[: at + 1] for name in names for at, letter in enumerate(name) if letter == "/")}

    def fields(folder: str) -> int:
        return len(
            set(choose([name.removeprefix(folder) for name in names if name.startswith(folder)]).values())
        )

    return max(sorted(parents, key=lambda one: (one.count("/"), one))[:MOST_GROUPS], key=fields)
