"""Reader of JSON documents: named lists, or a list of records at any key."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..log import LogError
from .names import JOINT_NAMES_FIELD
from .raw import ColumnChooser, RawArrays, check_size, open_bytes

MAX_DOCUMENT_CHARS = 100_000_000
"""Characters of a JSON document, which is parsed in memory."""


def read_json(path: Path, choose: ColumnChooser) -> RawArrays:
    """Read a document of named lists or of a list of records; a number applies to all rows.

    Args:
        path: The file.
        choose: Selects the lists to read.

    Returns:
        The selected arrays.

    Raises:
        LogError: The text is no JSON, is too long, or a list holds no numbers.
    """
    with open_bytes(path) as file:
        text = file.read(MAX_DOCUMENT_CHARS + 1)
    if len(text) > MAX_DOCUMENT_CHARS:
        raise LogError(
            f"{path}: more than {MAX_DOCUMENT_CHARS} characters; expected an NPZ archive of so much"
        )
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise LogError(f"{path}: no JSON document: {str(error)[:100]}") from None
    named = document if isinstance(document, dict) else {"rows": document}
    columns: dict[str, Any] = {name: value for name, value in named.items() if not _is_records(value)}
    for value in named.values():
        if _is_records(value):
            columns |= {name: [row.get(name) for row in value] for name in value[0]}
    arrays: dict[str, Any] = {}
    for name, field in choose(list(columns)).items():
        try:
            arrays[name] = np.array(columns[name], dtype=str if field == JOINT_NAMES_FIELD else float)
        except (ValueError, TypeError):
            raise LogError(
                f"{path}: {name}: found a value that is no number, or rows of unlike length"
            ) from None
    check_size(path, {name: values.shape for name, values in arrays.items()})
    return RawArrays(arrays, tuple(name for name in columns if name not in arrays))


def _is_records(value: Any) -> bool:
    """Whether a value is a list of dicts."""
    return isinstance(value, list) and len(value) > 0 and all(isinstance(row, dict) for row in value)
