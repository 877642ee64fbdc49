"""Messages as the recording itself defines them, handed on as the present definitions have them.

A definition may have changed since a recording was made. Its bytes are read by the definition that the file carries; fields
that came later get their default, fields that are gone are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from .definitions import DEFAULTS, STORE, ZEROS

Description = Any  # of a field, as rosbags has it: a kind of node, and what it is made of


def is_known(typename: str, recorded: MessageDefinition) -> bool:
    """Whether the recording or we define a type. `recorded`: the definition that the recording has of it, if any."""
    return typename in _store(typename, recorded).fielddefs


def read(data: bytes, typename: str, recorded: MessageDefinition, ros1: bool = False) -> Any:
    """The message that these bytes (CDR, or ROS 1's own) are, of a known type.

    It has the fields of the present definition; of a type that we do not know, those of the recorded one. Where the recording
    has no definition, an empty one, or none in the form of a .msg file, the present one counts.
    """
    store = _store(typename, recorded)
    return store.deserialize_ros1(data, typename) if ros1 else store.deserialize_cdr(data, typename)


@cache
def _store(typename: str, recorded: MessageDefinition) -> Any:
    """The present definitions, or those of the recording where they differ."""
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
    except TypesysError:  # with what rosbags does not know, such as wide strings
        return STORE
    for name in types.keys() & STORE.fielddefs.keys():
        store.types[name] = _present(name, [field for field, _ in _fields(store, name)])  # type: ignore[assignment]
    return store


def _fields(store: Any, typename: str) -> list[tuple[str, Description]]:
    fields: list[tuple[str, Description]] = store.fielddefs[typename][1]
    return fields


def _present(typename: str, recorded: list[str]) -> Callable[..., Any]:
    """What makes a message of the present definition of the values of the recorded fields, in their order."""
    make = STORE.types[typename]
    later = [(name, kind) for name, kind in _fields(STORE, typename) if name not in recorded]
    kept = {name for name, _ in _fields(STORE, typename)}

    def present(*values: Any) -> Any:
        given = {name: value for name, value in zip(recorded, values, strict=True) if name in kept}
        return make(**given, **{name: _default(typename, name, kind) for name, kind in later})

    return present


def _default(typename: str, field: str, description: Description) -> Any:
    """The default of a field as ROS 2 has it."""
    kind, detail = description
    if kind == Nodetype.NAME:
        return STORE.types[detail](*(_default(detail, *each) for each in _fields(STORE, detail)))
    if kind == Nodetype.BASE:
        return DEFAULTS.get((typename, field), ZEROS.get(detail[0], 0))
    item, length = detail
    values = [_default(typename, field, item) for _ in range(length if kind == Nodetype.ARRAY else 0)]
    if item[0] == Nodetype.NAME or item[1][0] == "string":
        return values
    return np.array(values, {"char": "uint8"}.get(item[1][0], item[1][0]))
