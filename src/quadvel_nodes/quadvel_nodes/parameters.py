"""Parameters of a node as records of attrs, which may contain further records. Knows no ROS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import attrs

Record = TypeVar("Record")


def parameter_fields(record: type) -> dict[str, attrs.Attribute[Any]]:
    """Return the parameters of a record: its fields, and those of the records that it contains.

    Args:
        record: An attrs class. A field whose default is a record stands for the fields of that one.

    Returns:
        Fields with a default and the metadata `description`, by name, which is unique.
    """
    fields: dict[str, attrs.Attribute[Any]] = {}
    for field in attrs.fields(record):
        part = type(field.default)
        fields |= parameter_fields(part) if attrs.has(part) else {field.name: field}
    return fields


def make_record(record: type[Record], values: Mapping[str, Any]) -> Record:
    """Create a record, with the records that it contains, from parameters.

    Args:
        record: An attrs class, as for `parameter_fields`.
        values: Values by name of the parameter; the default of a missing one is used.

    Returns:
        The record.

    Raises:
        ValueError: A validator refuses a value; the message begins with the parameter.
    """
    given: dict[str, Any] = {}
    for field in attrs.fields(record):  # type: ignore[arg-type]
        part = type(field.default)
        if attrs.has(part):
            given[field.name] = make_record(part, values)
        elif field.name in values:
            given[field.name] = values[field.name]
    try:
        return record(**given)
    except ValueError as error:
        raise ValueError(str(error).removeprefix(f"{record.__name__}.")) from error
