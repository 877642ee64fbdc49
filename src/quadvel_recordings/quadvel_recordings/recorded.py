"""Deserialisation by the recorded definition, conversion to the present definition.

A definition may have changed since the recording was made. Fields added since then get their
default value; fields removed since then are dropped.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from .definitions import FIELD_DEFAULTS, STORE, TYPE_DEFAULTS

Description = Any  # description of a field in rosbags: a kind of node, and its details


def is_known(typename: str, recorded: MessageDefinition) -> bool:
    """Return whether the recording or `definitions` defines a type.

    Args:
        typename: Such as "geometry_msgs/msg/Twist".
        recorded: The definition in the recording, if any.

    Returns:
        True if messages of the type can be deserialised.
    """
    return typename in _store(typename, recorded).fielddefs


def deserialize(data: bytes, typename: str, recorded: MessageDefinition, ros1: bool = False) -> Any:
    """Deserialise a message of a known type.

    Args:
        data: CDR bytes, or bytes of the ROS 1 format.
        typename: Such as "geometry_msgs/msg/Twist".
        recorded: The definition in the recording; the present one applies if it is empty or not in
            .msg format.
        ros1: Whether the bytes have the ROS 1 format.

    Returns:
        The message with the fields of the present definition; of an unknown type with those of the
        recorded one.
    """
    store = _store(typename, recorded)
    return store.deserialize_ros1(data, typename) if ros1 else store.deserialize_cdr(data, typename)


@cache
def _store(typename: str, recorded: MessageDefinition) -> Any:
    """Return the present definitions, or a store of the recorded ones if they differ."""
    if recorded.format != MessageDefinitionFormat.MSG or not recorded.data.strip():
        return STORE
    try:
        types = get_types_from_msg(recorded.data, typename)
        if all(
            name in STORE.fielddefs and _fields(STORE, name) == fields for name, (_, fields) in types.items()
        ):
            return STORE
        store = get_typestore(Stores.EMPTY)
        store.register(types)
    except TypesysError:  # the definition uses a feature that rosbags lacks, such as wide strings
        return STORE
    for name in types.keys() & STORE.fielddefs.keys():
        store.types[name] = _converter(name, [field for field, _ in _fields(store, name)])  # type: ignore[assignment]
    return store


def _fields(store: Any, typename: str) -> list[tuple[str, Description]]:
    """Return names and descriptions of the fields of a type."""
    fields: list[tuple[str, Description]] = store.fielddefs[typename][1]
    return fields


def _converter(typename: str, recorded: list[str]) -> Callable[..., Any]:
    """Return a constructor of the present message from the recorded fields, in their order."""
    make = STORE.types[typename]
    later = [(name, kind) for name, kind in _fields(STORE, typename) if name not in recorded]
    kept = {name for name, _ in _fields(STORE, typename)}

    def present(*values: Any) -> Any:
        given = {name: value for name, value in zip(recorded, values, strict=True) if name in kept}
        return make(**given, **{name: _default(typename, name, kind) for name, kind in later})

    return present


def _default(typename: str, field: str, description: Description) -> Any:
    """Return the default value of a field as ROS 2 defines it."""
    kind, detail = description
    if kind == Nodetype.NAME:
        return STORE.types[detail](*(_default(detail, *each) for each in _fields(STORE, detail)))
    if kind == Nodetype.BASE:
        return FIELD_DEFAULTS.get((typename, field), TYPE_DEFAULTS.get(detail[0], 0))
    item, length = detail
    values = [_default(typename, field, item) for _ in range(length if kind == Nodetype.ARRAY else 0)]
    if item[0] == Nodetype.NAME or item[1][0] == "string":
        return values
    return np.array(values, {"char": "uint8"}.get(item[1][0], item[1][0]))
