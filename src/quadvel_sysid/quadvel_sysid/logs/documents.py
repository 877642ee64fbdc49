"""JSON documents: named lists, or a list of records, wherever it stands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from .log import LogError
from .names import NAMES
from .raw import Choose, Raw, check_size, opened

LARGEST_DOCUMENT = 100_000_000
"""Characters of a JSON document, which is read whole."""


def read(path: Path, choose: Choose) -> Raw:
    """A document of named lists, or of a list of records, wherever it stands; numbers beside it count for all rows."""
    with opened(path) as file:
        text = file.read(LARGEST_DOCUMENT + 1)
    if len(text) > LARGEST_DOCUMENT:
        raise LogError(f"{path}: more than {LARGEST_DOCUMENT} characters; expected an NPZ archive of so much")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise LogError(f"{path}: no JSON document: {str(error)[:100]}") from None
    named = document if isinstance(document, dict) else {"rows": document}
    columns: dict[str, Any] = {name: value for name, value in named.items() if not _records(value)}
    for value in named.values():
        if _records(value):
            columns |= {name: [row.get(name) for row in value] for name in value[0]}
    arrays: dict[str, Any] = {}
    for name, field in choose(list(columns)).items():
        try:
            arrays[name] = np.array(columns[name], dtype=str if field == NAMES else float)
        except (ValueError, TypeError):
            raise LogError(f"{path}: {name}: found what is no number, or rows of unlike length") from None
    check_size(path, {name: values.shape for name, values in arrays.items()})
    return Raw(arrays, tuple(name for name in columns if name not in arrays))


def _records(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(isinstance(row, dict) for row in value)
