"""Cyclone DDS types of the messages.

Cyclone drops received samples that do not fit these types. The stack keeps the bytes of a sample
(CDR), which `messages` writes and reads.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl_types
from rosbags.interfaces import Nodetype

from quadvel_dds import messages

types: Any = idl_types  # mypy does not know types.array[...]
BASE = {"bool": bool, "char": types.uint8, "string": str}
REQUEST_HEADER = {"client_guid_": types.uint64, "sequence_number_": types.int64}


@cache
def struct(typename: str) -> Any:
    """Create the Cyclone type of a message, or of a service request or response.

    The latter start with the request header of rmw_cyclonedds.

    Args:
        typename: Full name, such as `geometry_msgs/msg/Twist`.

    Returns:
        Type whose samples hold CDR bytes as `data`.
    """
    fields = {f"{name}_": _field(description) for name, description in messages.STORE.fielddefs[typename][1]}
    if "/srv/" in typename:
        fields = REQUEST_HEADER | fields
    made: Any = make_idl_struct(typename.rpartition("/")[2], messages.dds_name(typename), fields)
    made.__init__ = lambda sample, data: setattr(sample, "data", data)
    made.serialize = lambda sample, **options: sample.data
    made.deserialize = made.deserialize_key = classmethod(lambda cls, data, **options: cls(data))
    return made


def _field(description: Any) -> type[IdlStruct] | Any:
    """Return the Cyclone type of a field."""
    kind, detail = description
    if kind == Nodetype.NAME:
        return struct(detail)
    if kind == Nodetype.BASE:
        name, bound = detail
        return types.bounded_str[bound] if bound else BASE.get(name) or getattr(types, name)
    item, count = _field(detail[0]), detail[1]
    if kind == Nodetype.ARRAY:
        return types.array[item, count]
    return types.sequence[item, count] if count else types.sequence[item]
