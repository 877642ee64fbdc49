"""Records from mappings, as YAML files and recipes hold them; errors name the place in the file."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, get_origin

import attrs
import cattrs
import numpy as np
from cattrs.cols import is_mapping, is_sequence, list_structure_factory
from cattrs.gen import make_dict_structure_fn

from .bounded_yaml import read_yaml
from .fields import Numbers
from .name_list import format_names

Record = TypeVar("Record")
PLAIN_TYPES: Mapping[type, tuple[tuple[type, ...], str]] = {
    float: ((float, int), "a number"),
    int: ((int,), "a whole number"),
    bool: ((bool,), "true or false"),
    str: ((str,), "a text"),
}
"""Accepted types of a value, and what is expected, by type of the field."""


def read_document(path: Path, expected: str, schema: int) -> dict[str, Any]:
    """Read the fields of a YAML file that states its schema. OSError propagates.

    Args:
        path: The file.
        expected: Its content, for the error message.
        schema: Version that the code reads.

    Returns:
        Its fields without `schema`.

    Raises:
        ValueError: The file cannot be read as such; the message names file, value found and
            expectation.
    """
    fields = dict(_mapping(read_yaml(path, expected), f"{path}: "))
    found = fields.pop("schema", None)
    if found != schema or isinstance(found, bool):
        raise ValueError(f"{path}: schema: found {found!r}, expected {schema}")
    return fields


def structure_record(kind: type[Record], content: object, path: Path | None = None) -> Record:
    """Make an attrs record from nested mappings and lists.

    Args:
        kind: The attrs class; its annotations give the types of nested records.
        content: The mapping.
        path: File of the content, for the error message.

    Returns:
        The record.

    Raises:
        ValueError: A field is unknown, missing or wrong; the message names file, place, value found
            and expectation.
    """
    prefix = "" if path is None else f"{path}: "
    fields = _mapping(content, prefix)
    _check_kind(kind, fields, prefix)
    try:
        return _CONVERTER.structure(fields, kind)
    except cattrs.BaseValidationError as error:
        texts = cattrs.transform_error(error, path="", format_exception=_explain)
    raise ValueError(prefix + "; ".join(_place_first(text) for text in texts)) from None


def _check_kind(kind: type, fields: Mapping[str, Any], prefix: str) -> None:
    """Refuse a mapping that lacks most of the required fields: probably a file of another kind."""
    required = [field.name for field in attrs.fields(kind) if field.default is attrs.NOTHING]
    missing = [name for name in required if name not in fields]
    if fields and len(missing) > max(1, len(required) // 2):
        raise ValueError(
            f"{prefix}found the fields {format_names([*fields])}, expected {format_names(required)}"
        )


def _explain(error: BaseException, kind: type | None) -> str:
    """Describe one error of cattrs or of a validator."""
    if isinstance(error, cattrs.ForbiddenExtraKeysError):
        names = ", ".join(field.name for field in attrs.fields(error.cl))
        return f"found the field {sorted(error.extra_fields)[0]!r}, expected one of {names}"
    if isinstance(error, KeyError):
        return "found nothing, expected a value"
    return str(error)


def _place_first(text: str) -> str:
    """Move the place of an error, which cattrs appends as `@ .walls[0]`, to its front."""
    what, _, place = text.rpartition(" @ ")
    place = place.strip(".")
    return f"{place}: {what}" if place else what


def _mapping(value: object, prefix: str = "") -> Mapping[str, Any]:
    """Return a value that is a mapping, else raise ValueError."""
    if not isinstance(value, Mapping):
        found = "nothing" if value is None else repr(value)
        raise ValueError(f"{prefix}found {found}, expected fields with their values")
    return value


def _record_hook(kind: type, converter: cattrs.Converter) -> Any:
    """Structure an attrs class from a mapping, without unknown fields."""
    structure = make_dict_structure_fn(kind, converter, _cattrs_forbid_extra_keys=True)
    return lambda value, _: structure(_mapping(value), kind)


def _list_hook(kind: type, converter: cattrs.Converter) -> Any:
    """Structure a sequence from a list; it becomes a tuple unless the type is a list."""
    structure = list_structure_factory(kind, converter)
    made = list if get_origin(kind) is list else tuple

    def checked(value: object, _: Any) -> Any:
        if not isinstance(value, list | tuple):
            raise ValueError(f"found {value!r}, expected a list")
        return made(structure(value, kind))

    return checked


def _numbers(value: Any, _: Any) -> Any:
    """Structure `Numbers`: one number, or a tuple of them from a list."""
    return _CONVERTER.structure(value, tuple[float, ...] if isinstance(value, list | tuple) else float)


def _is_array(kind: Any) -> bool:
    """Whether the type of a field is an array."""
    return bool(get_origin(kind) is np.ndarray)


def _plain(value: Any, kind: type) -> Any:
    """Check a number, truth value or text."""
    accepted, expected = PLAIN_TYPES[kind]
    if isinstance(value, accepted) and (kind is bool or not isinstance(value, bool)):
        return kind(value)
    if kind is float and isinstance(value, str):  # PyYAML reads 1e-3 as a text
        with suppress(ValueError):
            return float(value)
    raise ValueError(f"found {value!r}, expected {expected}")


_CONVERTER = cattrs.Converter()
_CONVERTER.register_structure_hook_factory(attrs.has, _record_hook)
_CONVERTER.register_structure_hook_factory(is_sequence, _list_hook)
_CONVERTER.register_structure_hook_func(is_mapping, lambda value, _: dict(_mapping(value)))
_CONVERTER.register_structure_hook_func(lambda kind: kind == Numbers, _numbers)
_CONVERTER.register_structure_hook_func(_is_array, lambda value, _: value)  # the field converts it
for _kind in PLAIN_TYPES:
    _CONVERTER.register_structure_hook(_kind, _plain)
