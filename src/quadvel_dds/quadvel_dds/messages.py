"""Message and service classes that look and behave like those which ROS 2 generates for Python.

Definitions and their bytes are those of `rosbags`; a class is made when it is first asked for. As in ROS 2, fields are
not checked on assignment. A value that cannot be sent raises ValueError when it is published, where ROS 2 would cut it
off or read past its end.
"""

from __future__ import annotations

import array
from collections.abc import Callable
from functools import cache
from typing import Any, ClassVar

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from quadvel_recordings import definitions

Description = Any  # of a field, as rosbags has it: a kind of node, and what it is made of
HEADER = b"\x00\x01\x00\x00"  # encapsulation: plain CDR, little endian, no options
FORMATS = {
    "bool": "?", "byte": "b", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip

STORE = get_typestore(Stores.EMPTY)
"""All definitions, with our classes in the place of those that rosbags would make."""
STORE.register(definitions.STORE.fielddefs)


def is_interface_package(package: str) -> bool:
    return any(name.startswith(f"{package}/") for name in STORE.fielddefs)


def names_in(package: str, kind: str) -> list[str]:
    """Names of a package's messages ("msg"), or of its services with their requests and responses ("srv")."""
    prefix = f"{package}/{kind}/"
    names = {name.removeprefix(prefix) for name in STORE.fielddefs if name.startswith(prefix)}
    return sorted(names | {name.removesuffix("_Request") for name in names})


class Message:
    """Base of all message classes: comparison and text form."""

    __slots__: ClassVar[tuple[str, ...]] = ()
    TYPENAME: ClassVar[str]

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(np.array_equal(getattr(self, s), getattr(other, s)) for s in self.__slots__)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        package, kind, name = self.TYPENAME.split("/")
        fields = ", ".join(f"{s[1:]}={getattr(self, s)!r}" for s in self.__slots__)
        return f"{package}.{kind}.{name}({fields})"


class Octet(bytes):
    """A field of type byte: one byte for those who use it, a number for rosbags."""

    def __index__(self) -> int:
        return int.from_bytes(self, signed=True)


class Numbers(array.array):  # type: ignore[type-arg]
    """A sequence of numbers: an array.array as in ROS 2, with what rosbags asks of a NumPy array."""

    def view(self, dtype: Any) -> Any:
        return np.frombuffer(self.tobytes(), dtype)


class Flags(list):  # type: ignore[type-arg]
    """An array or a sequence of bools or bytes: a list as in ROS 2, with what rosbags asks of a NumPy array."""

    def view(self, dtype: Any) -> Any:
        return np.frombuffer(b"".join(bytes([v]) if isinstance(v, bool) else v for v in self), dtype)


@cache
def message_class(typename: str) -> type[Message]:
    """The class of a message, a request or a response, by its full name ("geometry_msgs/msg/Twist")."""
    if typename not in STORE.fielddefs:
        raise KeyError(f"message type '{typename}' is not known to quadvel_dds")
    constants, fields = STORE.fielddefs[typename]
    package, kind, name = typename.split("/")
    namespace: dict[str, Any] = {
        "__slots__": tuple(f"_{field}" for field, _ in fields),
        "__module__": f"{package}.{kind}",
        "__doc__": f"Message {typename}.",
        "TYPENAME": typename,
    }
    for constant, base, value in constants:
        namespace[constant] = bytes([int(value)]) if base == "byte" else value
    cls = type(name, (Message,), namespace)
    for field, description in fields:
        setattr(cls, field, _accessor(cls.__dict__[f"_{field}"], _converter(description)))
    cls.__init__ = _make_init(typename, fields)  # type: ignore[misc]  # makes the classes of its fields too
    STORE.types[typename] = _make_reader(cls, fields)  # type: ignore[assignment]
    return cls


@cache
def service_class(typename: str) -> type:
    """The class of a service by its full name ("std_srvs/srv/Trigger"), with `Request` and `Response`."""
    package, kind, name = typename.split("/")
    parts = {part: message_class(f"{typename}_{part}") for part in ("Request", "Response")}
    return type(name, (), {"__module__": f"{package}.{kind}", "TYPENAME": typename, **parts})


def serialize(message: Message, prefix: bytes = b"") -> bytearray:
    """CDR bytes of a message, encapsulation header included, padded to a multiple of four.

    `prefix` goes in front of the content: the header of a service call, a multiple of eight bytes. Raises ValueError
    that says why.
    """
    try:
        content = STORE.serialize_cdr(message, message.TYPENAME, little_endian=True)[4:]
    except Exception as error:
        raise ValueError(f"{message.TYPENAME} cannot be sent: {fault(message) or error}") from error
    data = bytearray(HEADER + prefix)
    data += content
    data += bytes(-len(data) % 4)
    return data


def deserialize(data: bytes, typename: str, prefix_size: int = 0) -> Any:
    """Message from its CDR bytes. Raises ValueError where they do not hold one."""
    if data[:2] != HEADER[:2]:
        raise ValueError(
            f"{typename}: encapsulation {data[:2].hex()} found, expected 0001 (little-endian CDR)"
        )
    message_class(typename)
    try:
        # A copy, for arrays that may be written to.
        return STORE.deserialize_cdr(memoryview(bytearray(HEADER + data[4 + prefix_size :])), typename)
    except Exception as error:
        raise ValueError(f"{typename} cannot be read: {error}") from error


@cache
def type_hash(typename: str) -> str:
    return str(STORE.hash_rihs01(typename))


def dds_name(typename: str) -> str:
    """Name of the type on the wire: "geometry_msgs::msg::dds_::Twist_"."""
    package, kind, name = typename.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _accessor(slot: Any, convert: Callable[[Any], Any] | None) -> Any:
    """How a field is read and assigned: plainly, or converted."""
    if convert is None:
        return slot
    store = slot.__set__
    return property(slot.__get__, lambda self, value: store(self, convert(value)))


def _converter(description: Description) -> Callable[[Any], Any] | None:
    """What makes of an assigned value what is kept; None where it is kept as it is."""
    kind, detail = description
    if kind == Nodetype.NAME:
        return None
    if kind == Nodetype.BASE:
        return (
            (lambda value: Octet(value) if isinstance(value, bytes) else value)
            if detail[0] == "byte"
            else None
        )
    item = detail[0]
    if item[0] == Nodetype.NAME or item[1][0] == "string":
        return None
    base = item[1][0]
    if base in ("bool", "byte"):
        return Flags
    dtype = np.dtype(FORMATS[base])
    if kind == Nodetype.ARRAY:
        return lambda value: np.array(value, dtype)

    def to_sequence(value: Any) -> Any:
        return Numbers(dtype.char, value.tolist() if isinstance(value, np.ndarray) else value)

    return to_sequence


def _from_bytes(description: Description) -> Callable[[Any], Any] | None:
    """What makes of a value that rosbags read what is kept; None where it is kept as it is."""
    kind, detail = description
    if kind == Nodetype.BASE:
        return (lambda value: Octet([value % 256])) if detail[0] == "byte" else None
    if kind == Nodetype.NAME or detail[0][0] == Nodetype.NAME or detail[0][1][0] == "string":
        return None
    base = detail[0][1][0]
    if base == "bool":
        return lambda values: Flags(values.tolist())
    if base == "byte":
        return lambda values: Flags(bytes([value % 256]) for value in values.tolist())
    code = FORMATS[base]
    return None if kind == Nodetype.ARRAY else lambda values: Numbers(code, values.tobytes())


def _make_reader(cls: type, fields: Any) -> Callable[..., Any]:
    """Function that makes a message of the values of its fields as rosbags read them."""
    conversions = [(f"_{field}", _from_bytes(description)) for field, description in fields]
    names: dict[str, Any] = {"new": object.__new__, "cls": cls}
    lines = [f"def read({', '.join(slot for slot, _ in conversions)}):", "    m = new(cls)"]
    for slot, convert in conversions:
        names[f"convert{slot}"] = convert
        lines.append(f"    m.{slot} = {f'convert{slot}({slot})' if convert else slot}")
    exec("\n".join([*lines, "    return m"]), names)
    return names["read"]


def _default(typename: str, field: str, description: Description) -> Callable[[], Any]:
    """Function that makes the default value of a field."""
    kind, detail = description
    if kind == Nodetype.NAME:
        return message_class(detail)
    if kind == Nodetype.BASE:
        zero = Octet(1) if detail[0] == "byte" else definitions.TYPE_DEFAULTS.get(detail[0], 0)
        value = definitions.FIELD_DEFAULTS.get((typename, field), zero)
        return lambda: value
    item, count = _default(typename, field, detail[0]), detail[1] if kind == Nodetype.ARRAY else 0
    convert = _converter(description) or list
    return lambda: convert([item() for _ in range(count)])


def _make_init(typename: str, fields: Any) -> Callable[..., None]:
    """`__init__` with one keyword argument a field; what is not given gets its default."""
    names: dict[str, Any] = {}
    lines = [f"def __init__(self, *, {', '.join(f'{field}=None' for field, _ in fields)}):"]
    for field, description in fields:
        names[f"make_{field}"] = _default(typename, field, description)
        lines += [
            f"    if {field} is None: self._{field} = make_{field}()",
            f"    else: self.{field} = {field}",
        ]
    exec("\n".join(lines), names)
    return names["__init__"]


def fault(message: Message) -> str | None:
    """The first field, nested ones included, that cannot be sent, in a sentence; None if all can."""
    for field, _ in STORE.fielddefs[message.TYPENAME][1]:
        value = getattr(message, f"_{field}")
        if isinstance(value, Message) and (inner := fault(value)):
            return inner
        alone = type(message)()
        setattr(alone, f"_{field}", value)
        try:
            STORE.serialize_cdr(alone, message.TYPENAME)
        except Exception as error:
            return f"field '{field}' holds {value!r}: {error}"
    return None
