"""Message and service classes that look and behave like those which ROS 2 generates for Python.

Definitions come from `quadvel_recordings`; a class is made when it is first asked for. As in ROS 2, fields are not
checked on assignment unless the environment variable ROS_PYTHON_CHECK_FIELDS is 1 (then a wrong type, range or length
raises AssertionError). A value that cannot be sent raises ValueError when it is published, where ROS 2 would cut it
off or read past its end.
"""

from __future__ import annotations

import array
import os
from collections.abc import Callable, Sequence, Set
from functools import cache
from typing import Any, ClassVar

import numpy as np
from rosbags.interfaces import Nodetype

from quadvel_dds import cdr
from quadvel_recordings.definitions import STORE

# Default values, which the definitions carried by rosbags leave out.
DEFAULTS = {
    ("geometry_msgs/msg/Quaternion", "w"): 1.0,
    ("sensor_msgs/msg/NavSatStatus", "status"): -2,
}
CHECK_FIELDS = os.environ.get("ROS_PYTHON_CHECK_FIELDS") == "1"

Describe = tuple[type, cdr.Fields]


def is_interface_package(package: str) -> bool:
    return any(name.startswith(f"{package}/") for name in STORE.fielddefs)


def names_in(package: str, kind: str) -> list[str]:
    """Names of a package's messages ("msg"), or of its services with their requests and responses ("srv")."""
    prefix = f"{package}/{kind}/"
    names = {name.removeprefix(prefix) for name in STORE.fielddefs if name.startswith(prefix)}
    return sorted(names | {name.removesuffix("_Request") for name in names})


class Message:
    """Base of all message classes: comparison, text form, and what those of ROS 2 tell about themselves."""

    __slots__: ClassVar[tuple[str, ...]] = ()
    TYPENAME: ClassVar[str]
    _fields_and_field_types: ClassVar[dict[str, str]]

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        return dict(cls._fields_and_field_types)

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(np.array_equal(getattr(self, s), getattr(other, s)) for s in self.__slots__)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        package, kind, name = self.TYPENAME.split("/")
        fields = ", ".join(f"{s[1:]}={getattr(self, s)!r}" for s in self.__slots__)
        return f"{package}.{kind}.{name}({fields})"


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
        "_fields_and_field_types": {field: type_text(description) for field, description in fields},
    }
    for constant, base, value in constants:
        namespace[constant] = bytes([value]) if base == "byte" else value
    cls = type(name, (Message,), namespace)
    for field, description in fields:
        setattr(cls, field, _accessor(cls, field, description))
    cls.__init__ = _make_init(cls, typename, fields)  # type: ignore[misc]
    return cls


@cache
def service_class(typename: str) -> type:
    """The class of a service by its full name ("std_srvs/srv/Trigger"), with `Request` and `Response`."""
    package, kind, name = typename.split("/")
    parts = {part: message_class(f"{typename}_{part}") for part in ("Request", "Response")}
    return type(name, (), {"__module__": f"{package}.{kind}", "TYPENAME": typename, **parts})


def describe(typename: str) -> Describe:
    return message_class(typename), STORE.fielddefs[typename][1]


@cache
def writer(typename: str) -> Callable[..., None]:
    return cdr.make_writer(typename, describe)


@cache
def reader(typename: str) -> Callable[..., Any]:
    return cdr.make_reader(typename, describe)


def serialize(message: Message, prefix: bytes = b"") -> bytearray:
    """CDR bytes of a message, encapsulation header included, padded to a multiple of four.

    `prefix` goes in front of the content: the header of a service call. Raises ValueError that says why.
    """
    data = bytearray(cdr.HEADER + prefix)
    try:
        writer(message.TYPENAME)(message, data)
    except Exception as error:
        try:
            check_message(message)
        except AssertionError as reason:
            raise ValueError(f"{message.TYPENAME} cannot be sent: {reason}") from error
        raise ValueError(f"{message.TYPENAME} cannot be sent: {error}") from error
    data += bytes(-len(data) % 4)
    return data


def deserialize(data: bytes, typename: str, prefix_size: int = 0) -> Any:
    """Message from its CDR bytes. Raises ValueError where they do not hold one."""
    if data[:2] != cdr.HEADER[:2]:
        raise ValueError(
            f"{typename}: encapsulation {data[:2].hex()} found, expected 0001 (little-endian CDR)"
        )
    try:
        return reader(typename)(data, 4 + prefix_size)
    except Exception as error:
        raise ValueError(f"{typename} cannot be read: {error}") from error


@cache
def type_hash(typename: str) -> str:
    return str(STORE.hash_rihs01(typename))


def dds_name(typename: str) -> str:
    """Name of the type on the wire: "geometry_msgs::msg::dds_::Twist_"."""
    package, kind, name = typename.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def type_text(description: Any) -> str:
    """Type of a field as `get_fields_and_field_types` of ROS 2 writes it."""
    kind, detail = description
    if kind == Nodetype.NAME:
        package, _, name = detail.split("/")
        return f"{package}/{name}"
    if kind == Nodetype.BASE:
        name, bound = detail
        renamed = {
            "bool": "boolean",
            "byte": "octet",
            "char": "uint8",
            "float32": "float",
            "float64": "double",
        }
        return f"string<{bound}>" if bound else renamed.get(name, name)
    inner, count = type_text(detail[0]), detail[1]
    if kind == Nodetype.ARRAY:
        return f"{inner}[{count}]"
    return f"sequence<{inner}, {count}>" if count else f"sequence<{inner}>"


def _accessor(cls: type, field: str, description: Any) -> Any:
    """How a field is read and assigned: plainly, with conversion to one block of numbers, or checked."""
    slot = cls.__dict__[f"_{field}"]
    convert = _converter(description)
    if CHECK_FIELDS:
        store = slot.__set__
        checked = _checked(field, description)
        return property(slot.__get__, lambda self, value: store(self, convert(checked(value))))
    if cdr.is_numeric(description):
        store = slot.__set__
        return property(slot.__get__, lambda self, value: store(self, convert(value)))
    return slot


def _converter(description: Any) -> Callable[[Any], Any]:
    kind, detail = description
    if not cdr.is_numeric(description):
        return lambda value: value
    code = cdr.FORMATS[detail[0][1][0]]
    dtype = np.dtype(code)
    if kind == Nodetype.ARRAY:
        return lambda value: np.array(value, dtype)

    def to_sequence(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return array.array(code, value.astype(dtype, copy=False).tobytes())
        return array.array(code, value)

    return to_sequence


def _default(typename: str, field: str, description: Any) -> Callable[[], Any]:
    """Function that makes the default value of a field."""
    kind, detail = description
    if kind == Nodetype.NAME:
        return message_class(detail)
    if kind == Nodetype.BASE:
        zero = {"bool": False, "byte": b"\0", "string": "", "float32": 0.0, "float64": 0.0}.get(detail[0], 0)
        value = DEFAULTS.get((typename, field), zero)
        return lambda: value
    if cdr.is_numeric(description):
        code = cdr.FORMATS[detail[0][1][0]]
        if kind == Nodetype.ARRAY:
            return lambda: np.zeros(detail[1], code)
        return lambda: array.array(code)
    item = _default(typename, field, detail[0])
    count = detail[1] if kind == Nodetype.ARRAY else 0
    return lambda: [item() for _ in range(count)]


def _make_init(cls: type, typename: str, fields: cdr.Fields) -> Callable[..., None]:
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


def _checked(field: str, description: Any) -> Callable[[Any], Any]:
    def checked(value: Any) -> Any:
        check_field(field, description, value)
        return value

    return checked


def check_message(message: Message) -> None:
    """Raise AssertionError that names the first field, nested ones included, whose value does not fit."""
    for field, description in STORE.fielddefs[message.TYPENAME][1]:
        value = getattr(message, f"_{field}")
        check_field(field, description, value)
        for item in value if isinstance(value, list) else [value]:
            if isinstance(item, Message):
                check_message(item)


def check_field(field: str, description: Any, value: Any) -> None:
    """Raise AssertionError if a value does not fit the type of a field, as generated code of ROS 2 does."""
    kind, detail = description
    if kind == Nodetype.NAME:
        expected = f"a message of type {detail}"
        good = isinstance(value, message_class(detail))
    elif kind == Nodetype.BASE:
        expected = f"of type {detail[0]}"
        good = _fits(detail[0], value)
    else:
        item, count = detail
        limit = f"at most {count}" if kind == Nodetype.SEQUENCE else str(count)
        type_ = item[1] if item[0] == Nodetype.NAME else item[1][0]
        expected = f"{limit if count else 'any number of'} values of type {type_}"
        good = _items_fit(kind, item, count, value)
    assert good, f"field '{field}' must be {expected}, found {value!r}"


def _items_fit(kind: int, item: Any, count: int, value: Any) -> bool:
    """As ROS 2 has it, a NumPy array fits an array of its own type, but no sequence."""
    is_block = isinstance(value, np.ndarray) and kind == Nodetype.ARRAY and item[0] == Nodetype.BASE
    if isinstance(value, str) or not (is_block or isinstance(value, (Sequence, Set, array.array))):
        return False
    if count and (len(value) != count if kind == Nodetype.ARRAY else len(value) > count):
        return False
    if is_block:
        return bool(value.ndim == 1 and value.dtype == np.dtype(cdr.FORMATS[item[1][0]]))
    if item[0] == Nodetype.NAME:
        return all(isinstance(v, message_class(item[1])) for v in value)
    return all(_fits(item[1][0], v) for v in value)


def _fits(base: str, value: Any) -> bool:
    if base == "bool":
        return isinstance(value, bool)
    if base == "string":
        return isinstance(value, str)
    if base == "byte":
        return isinstance(value, bytes) and len(value) == 1
    if base in ("float32", "float64"):
        return isinstance(value, float) and not np.finfo(base).max < abs(value) < float("inf")
    limits = np.iinfo("uint8" if base == "char" else base)
    return isinstance(value, int) and limits.min <= value <= limits.max
