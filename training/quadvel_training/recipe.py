"""Recipe files: small YAML files whose fields replace the defaults of a stage's configuration.

`base: FILE` (beside the recipe) names another recipe to start from, so that recipes that are to be compared differ in what
they name and in nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cattrs
import yaml

BASE = "base"


class RecipeError(ValueError):
    """A recipe that cannot be meant, in one sentence with file and field."""


def read(kind: type[Any], path: Path | None) -> Any:
    """A configuration of the attrs class `kind`: its defaults, and instead of them the fields that the recipe names.

    Raises RecipeError, and FileNotFoundError where a file is missing.
    """
    converter = cattrs.Converter(forbid_extra_keys=True)
    try:
        fields = fields_of(path) if path else {}
        return converter.structure(_merged(cattrs.unstructure(kind()), fields), kind)
    except cattrs.BaseValidationError as error:
        raise RecipeError(f"{path}: " + "; ".join(cattrs.transform_error(error))) from None


def fields_of(path: Path) -> dict[str, Any]:
    """What a recipe says, with what its base says under it."""
    fields = yaml.safe_load(path.read_text()) or {}
    if not isinstance(fields, dict):
        raise RecipeError(f"{path}: found {fields!r}, expected fields and their values")
    base = fields.pop(BASE, None)
    return _merged(fields_of(path.parent / base), fields) if base else fields


def _merged(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of `over` in place of those of `under`, mapping by mapping."""
    merged = dict(under)
    for name, value in over.items():
        below = merged.get(name)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            value = _merged(below, value)
        merged[name] = value
    return merged
