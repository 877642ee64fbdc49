"""Recipe files: small YAML files whose fields replace the defaults of a stage's configuration.

`base: FILE`, in the folder of the recipe, names another recipe to start from. So recipes to be
compared differ only in the fields that they name.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from quadvel_description.bounded_yaml import read_yaml
from quadvel_description.records import structure_record

BASE = "base"


class RecipeError(ValueError):
    """Invalid recipe; the message names file and field."""


def read_recipe(kind: type[Any], path: Path | None) -> Any:
    """Read the configuration of a stage.

    Args:
        kind: attrs class of the configuration.
        path: recipe file; None for the defaults.

    Returns:
        An instance of `kind`.

    Raises:
        RecipeError: a field is unknown or has a wrong value.
        FileNotFoundError: a file is missing.
    """
    try:
        fields = read_fields(path) if path else {}
        record = structure_record(kind, _merged(attrs.asdict(kind()), fields), path)
    except ValueError as error:
        raise RecipeError(str(error)) from None
    return record


def read_fields(path: Path) -> dict[str, Any]:
    """Read the fields of a recipe, merged over those of its base.

    Args:
        path: recipe file.

    Returns:
        Fields by name.

    Raises:
        RecipeError: the file holds no mapping.
    """
    fields = read_yaml(path, "a recipe") or {}
    if not isinstance(fields, dict):
        raise RecipeError(f"{path}: found {fields!r}, expected fields and their values")
    base = fields.pop(BASE, None)
    return _merged(read_fields(path.parent / base), fields) if base else fields


def _merged(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge two mappings recursively; `over` wins."""
    merged = dict(under)
    for name, value in over.items():
        below = merged.get(name)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            value = _merged(below, value)
        merged[name] = value
    return merged
