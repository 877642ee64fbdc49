"""Message and service classes with the interface of those that ROS 2 generates for Python.

Definitions and serialization come from `rosbags`; a class is created at its first use. As in ROS 2,
fields are not checked on assignment. A value that cannot be sent raises ValueError when it is
published, where ROS 2 truncates it or reads past its end. `wire` sends and receives the bytes.
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

Description = Any  # type of a field as rosbags states it: (Nodetype, detail of that node)
HEADER = b"\x00\x01\x00\x00"  # encapsulation: plain CDR, little endian, no options
FORMATS = {
    "bool": "?", "byte": "b", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip

STORE = get_typestore(Stores.EMPTY)
"""All definitions; no classes yet. `message_class` adds each class when it is needed; the method
`register` of rosbags would create the classes of all types at once.
"""
STORE.fielddefs.update(definitions.STORE.fielddefs)


def is_interface_package(package: str) -> bool:
    """Return whether a package has message definitions.

    Args:
        package: Name of the package.

    Returns:
        Whether a definition of it is known.
    """
    return any(name.startswith(f"{package}/") for name in STORE.fielddefs)


def names_in(package: str, kind: str) -> list[str]:
    """List the definitions of a package.

    Args:
        package: Name of the package.
        kind: `msg`, or `srv` for services with their requests and responses.

    Returns:
        Sorted names.
    """
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
    """Value of a field of type byte: bytes of length 1 for users, a number for rosbags."""

    def __index__(self) -> int:
        return int.from_bytes(self, signed=True)


class Numbers(array.array):  # type: ignore[type-arg]
    """Sequence of numbers: an array.array as in ROS 2, with `view` of a NumPy array for rosbags."""

    def view(self, dtype: Any) -> Any:
        """Return the bytes as a NumPy array.

        Args:
            dtype: Type of the elements.

        Returns:
            The array.
        """
        return np.frombuffer(self.tobytes(), dtype)


class Flags(list):  # type: ignore[type-arg]
    """Array or sequence of bools or bytes: a list as in ROS 2, with the `view` of a NumPy array."""

    def view(self, dtype: Any) -> Any:
        """Return the bytes as a NumPy array.

        Args:
            dtype: Type of the elements.

        Returns:
            The array.
        """
        return np.frombuffer(b"".join(bytes([v]) if isinstance(v, bool) else v for v in self), dtype)


@cache
def message_class(typename: str) -> type[Message]:
    """Create the class of a message, request or response.

    Args:
        typename: Full name, such as `geometry_msgs/msg/Twist`.

    Returns:
        The class.

    Raises:
        KeyError: The type is unknown.
    """
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
    """Create the class of a service, with `Request` and `Response`.

    An unknown type raises KeyError, as in `message_class`.

    Args:
        typename: Full name, such as `std_srvs/srv/Trigger`.

    Returns:
        The class.
    """
    package, kind, name = typename.split("/")
    parts = {part: message_class(f"{typename}_{part}") for part in ("Request", "Response")}
    return type(name, (), {"__module__": f"{package}.{kind}", "TYPENAME": typename, **parts})


def serialize(message: Message, prefix: bytes = b"") -> bytearray:
    """Serialize a message to CDR.

    Args:
        message: The message.
        prefix: Bytes between the encapsulation header and the message, a multiple of eight: the
            header of a service call.

    Returns:
        CDR bytes with encapsulation header, padded to a multiple of four.

    Raises:
        ValueError: A field cannot be sent; the message names it.
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
    """Deserialize a message from CDR.

    Args:
        data: CDR bytes with encapsulation header.
        typename: Full name of the type.
        prefix_size: Number of bytes between the encapsulation header and the message.

    Returns:
        The message.

    Raises:
        ValueError: The bytes do not hold such a message.
    """
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
    """Compute the type hash (RIHS01) that ROS 2 publishes in discovery.

    Args:
        typename: Full name of the type.

    Returns:
        The hash.
    """
    return str(STORE.hash_rihs01(typename))


def dds_name(typename: str) -> str:
    """Return the name of a type on the wire.

    Args:
        typename: Full name of the type.

    Returns:
        Name such as `geometry_msgs::msg::dds_::Twist_`.
    """
    package, kind, name = typename.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _accessor(slot: Any, convert: Callable[[Any], Any] | None) -> Any:
    """Return the descriptor of a field: its slot, or a property that converts on assignment."""
    if convert is None:
        return slot
    store = slot.__set__
    return property(slot.__get__, lambda self, value: store(self, convert(value)))


def _converter(description: Description) -> Callable[[Any], Any] | None:
    """Return the conversion of an assigned value; None if there is none."""
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
    """Return the conversion of a value that rosbags has read; None if there is none."""
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
    """Return a function that creates a message from field values that rosbags has read."""
    conversions = [(f"_{field}", _from_bytes(description)) for field, description in fields]
    names: dict[str, Any] = {"new": object.__new__, "cls": cls}
    lines = [f"def read({', '.join(slot for slot, _ in conversions)}):", "    m = new(cls)"]
    for slot, convert in conversions:
        names[f"convert{slot}"] = convert
        lines.append(f"    m.{slot} = {f'convert{slot}({slot})' if convert else slot}")
    exec("\n".join([*lines, "    return m"]), names)
    return names["read"]


def _default(typename: str, field: str, description: Description) -> Callable[[], Any]:
    """Return a function that creates the default value of a field."""
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
    """Return `__init__` with one keyword argument per field; omitted fields get their defaults."""
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
    """Find the first field that cannot be sent, nested fields included.

    Args:
        message: The message.

    Returns:
        A sentence that names it; None if all fields can be sent.
    """
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
