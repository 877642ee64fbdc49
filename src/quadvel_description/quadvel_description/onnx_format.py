"""Reader and writer of the ONNX file format, without the package `onnx`.

The format is Protocol Buffers: a message is a sequence of fields, each a key (number and wire type,
as a varint) and a value. `MESSAGES` lists the fields of the format that a network can have. Fields
that are not in the list are dropped. `network_file` decides what is allowed.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from typing import Any

import attrs

MAX_VALUES = 500_000
"""Largest number of values in a file. Most arrays of numbers count as one value."""

FLOAT32 = 1
"""TensorProto.data_type of float32."""

INT, FLOAT, TEXT, BYTES = "int", "float", "text", "bytes"
OPAQUE = "opaque"
"""Numbers that are not decoded: kept and written back byte for byte."""
UNREAD = "unread"
"""A message kept as bytes, so that `network_file` can refuse it."""
WIRE_TYPES = {INT: 0, FLOAT: 5}
"""Wire type of numbers: 0 is a varint, 5 four bytes. All other kinds have 2: length, then bytes."""
FIXED_BYTES = {1: 8, 5: 4}
"""Length of a value in bytes, by wire type."""


@attrs.frozen
class Field:
    """A field of a message.

    Attributes:
        name: Its name.
        kind: One of the kinds above, or the name of a message.
        repeated: Whether it may occur several times.
    """

    name: str
    kind: str
    repeated: bool


# A line for each message: number, name and kind of each field; a star marks repeated fields.
_FORMAT = """
ModelProto: 1 ir_version int, 2 producer_name text, 3 producer_version text, 4 domain text, 5 model_version int,
    6 doc_string text, 7 graph GraphProto, 8 opset_import OperatorSetIdProto*, 14 metadata_props StringStringEntryProto*,
    20 training_info unread*, 25 functions unread*, 26 configuration unread*
OperatorSetIdProto: 1 domain text, 2 version int
StringStringEntryProto: 1 key text, 2 value text
GraphProto: 1 node NodeProto*, 2 name text, 5 initializer TensorProto*, 10 doc_string text, 11 input ValueInfoProto*,
    12 output ValueInfoProto*, 13 value_info ValueInfoProto*, 14 quantization_annotation unread*,
    15 sparse_initializer unread*, 16 metadata_props StringStringEntryProto*
NodeProto: 1 input text*, 2 output text*, 3 name text, 4 op_type text, 5 attribute AttributeProto*, 6 doc_string text,
    7 domain text, 8 overload text, 9 metadata_props StringStringEntryProto*, 10 device_configurations unread*
AttributeProto: 1 name text, 2 f float, 3 i int, 4 s bytes, 5 t TensorProto, 6 g unread, 7 floats opaque*,
    8 ints int*, 9 strings bytes*, 10 tensors unread*, 11 graphs unread*, 13 doc_string text, 14 tp unread,
    15 type_protos unread*, 20 type int, 21 ref_attr_name text, 22 sparse_tensor unread, 23 sparse_tensors unread*
TensorProto: 1 dims int*, 2 data_type int, 3 segment unread, 4 float_data opaque*, 5 int32_data opaque*,
    6 string_data bytes*, 7 int64_data opaque*, 8 name text, 9 raw_data bytes, 10 double_data opaque*,
    11 uint64_data opaque*, 12 doc_string text, 13 external_data unread*, 14 data_location int,
    16 metadata_props StringStringEntryProto*
ValueInfoProto: 1 name text, 2 type TypeProto, 3 doc_string text, 4 metadata_props StringStringEntryProto*
TypeProto: 1 tensor_type TypeProto.Tensor, 4 sequence_type unread, 5 map_type unread, 6 denotation text,
    7 opaque_type unread, 8 sparse_tensor_type unread, 9 optional_type unread
TypeProto.Tensor: 1 elem_type int, 2 shape TensorShapeProto
TensorShapeProto: 1 dim TensorShapeProto.Dimension*
TensorShapeProto.Dimension: 1 dim_value int, 2 dim_param text, 3 denotation text
"""
MESSAGES: dict[str, dict[int, Field]] = {
    kind: {
        int(number): Field(name, starred.rstrip("*"), starred.endswith("*"))
        for number, name, starred in (one.split() for one in fields.split(","))
    }
    for kind, fields in re.findall(r"^(\S+): (.*(?:\n    .*)*)", _FORMAT, re.MULTILINE)
}
"""Fields of each message by number."""


class FormatError(ValueError):
    """The bytes are not a valid message, or end within one."""


class TooManyValuesError(FormatError):
    """The file has more than MAX_VALUES values."""


@attrs.define
class Message:
    """A message of the format.

    Attributes:
        kind: Its name in `MESSAGES`.
        fields: Values of each field that occurs: int, float, str, bytes or `Message`. A text that
            is not UTF-8 stays bytes; an OPAQUE field stays encoded.
    """

    kind: str
    fields: dict[str, list[Any]] = attrs.field(factory=dict)

    def all(self, name: str) -> list[Any]:
        """Return all values of a field.

        Args:
            name: The field.

        Returns:
            Its values; empty if it does not occur.
        """
        return self.fields.get(name, [])

    def one(self, name: str, default: Any = None) -> Any:
        """Return the value of a field that occurs at most once.

        Args:
            name: The field.
            default: Result if it does not occur.

        Returns:
            Its value.
        """
        values = self.all(name)
        return values[0] if values else default

    def is_readable(self) -> bool:
        """Check the texts of this message, not those of messages in it.

        Returns:
            Whether all are UTF-8.
        """
        texts = [field.name for field in MESSAGES[self.kind].values() if field.kind == TEXT]
        return not any(isinstance(value, bytes) for name in texts for value in self.all(name))

    def parts(self) -> Iterator[tuple[str, Message | bytes]]:
        """Yield all messages in this one, outer ones first.

        Yields:
            "Message.field", and the message; its bytes if it was not read.
        """
        for field in MESSAGES[self.kind].values():
            if field.kind in MESSAGES or field.kind == UNREAD:
                for value in self.all(field.name):
                    yield f"{self.kind}.{field.name}", value
                    if isinstance(value, Message):
                        yield from value.parts()


def message(kind: str, **values: Any) -> Message:
    """Create a message.

    Args:
        kind: Its name in `MESSAGES`.
        **values: Values by field: one, or a list of them.

    Returns:
        The message.
    """
    return Message(
        kind, {name: value if isinstance(value, list) else [value] for name, value in values.items()}
    )


def float_value(name: str, shape: Sequence[int]) -> Message:
    """Create the description of an input or output of float32.

    Args:
        name: Name of the input or output.
        shape: Length of each dimension.

    Returns:
        The "ValueInfoProto".
    """
    dims = [message("TensorShapeProto.Dimension", dim_value=length) for length in shape]
    tensor = message("TypeProto.Tensor", elem_type=FLOAT32, shape=message("TensorShapeProto", dim=dims))
    return message("ValueInfoProto", name=name, type=message("TypeProto", tensor_type=tensor))


def parse(content: bytes) -> Message:
    """Read an ONNX file.

    Args:
        content: Content of the file.

    Returns:
        The "ModelProto".

    Raises:
        TooManyValuesError: It has more than MAX_VALUES values.
        FormatError: It is not an ONNX file, or is truncated.
    """
    return _Reader(content).message("ModelProto", 0, len(content))


def serialise(whole: Message) -> bytes:
    """Write a message.

    Args:
        whole: The message.

    Returns:
        Its bytes; `parse` reads them.
    """
    return b"".join(
        _encode_field(number, field.kind, value)
        for number, field in MESSAGES[whole.kind].items()
        for value in whole.all(field.name)
    )


class _Reader:
    """Reads messages from the bytes of one file."""

    def __init__(self, content: bytes) -> None:
        self._content, self._count_of_values = content, 0

    def message(self, kind: str, position: int, end: int) -> Message:
        """Read the message of a kind that lies from `position` to `end`."""
        known, found = MESSAGES[kind], Message(kind)
        while position < end:
            self._count()
            start = position
            key, position = self._varint(position, end)
            number, wire_type = divmod(key, 8)
            value = 0
            if wire_type == 0:
                value, after = self._varint(position, end)
            elif wire_type == 2:
                length, position = self._varint(position, end)
                after = position + length
            elif wire_type in FIXED_BYTES:
                after = position + FIXED_BYTES[wire_type]
            else:
                raise FormatError
            if after > end:
                raise FormatError
            if number in known:
                values = self._values(known[number], wire_type, value, (start, position, after))
                found.fields.setdefault(known[number].name, []).extend(values)
                if len(found.all(known[number].name)) > 1 and not known[number].repeated:
                    raise FormatError  # readers of the format differ in which one they use
            position = after
        return found

    def _values(self, field: Field, wire_type: int, varint: int, place: tuple[int, int, int]) -> list[Any]:
        """Read the values of a field.

        Args:
            field: The field.
            wire_type: Its encoding.
            varint: Its number, if it is encoded as one.
            place: Start of its key, start and end of its value.
        """
        start, position, after = place
        if field.kind == OPAQUE:
            return [self._content[start:after]]
        if field.kind == INT and wire_type == 0:
            return [_signed(varint)]
        if field.kind == INT and field.repeated and wire_type == 2:
            return self._numbers(position, after)
        if wire_type != WIRE_TYPES.get(field.kind, 2):
            raise FormatError
        if field.kind in MESSAGES:
            return [self.message(field.kind, position, after)]
        content = self._content[position:after]
        if field.kind == FLOAT:
            return [*struct.unpack("<f", content)]
        return [_text(content) if field.kind == TEXT else content]

    def _numbers(self, position: int, after: int) -> list[int]:
        """Read numbers that share one key."""
        values = []
        while position < after:
            self._count()
            value, position = self._varint(position, after)
            values.append(_signed(value))
        return values

    def _count(self) -> None:
        self._count_of_values += 1
        if self._count_of_values > MAX_VALUES:
            raise TooManyValuesError

    def _varint(self, position: int, end: int) -> tuple[int, int]:
        """Read a number of seven bits a byte; return it and the position after it."""
        value = 0
        for shift in range(0, 70, 7):
            if position >= end:
                raise FormatError
            byte = self._content[position]
            position += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value, position
        raise FormatError


def _signed(value: int) -> int:
    """Interpret 64 bits as a number with a sign."""
    value &= (1 << 64) - 1
    return value - (1 << 64) if value >> 63 else value


def _text(value: bytes) -> str | bytes:
    """Decode a text; return its bytes if it is not UTF-8."""
    try:
        return value.decode()
    except UnicodeDecodeError:
        return value


def _encode_field(number: int, kind: str, value: Any) -> bytes:
    """Write one field."""
    if kind == OPAQUE:
        return bytes(value)
    key = _varint(number << 3 | WIRE_TYPES.get(kind, 2))
    if kind == INT:
        return key + _varint(value)
    if kind == FLOAT:
        return key + struct.pack("<f", value)
    if isinstance(value, str | Message):
        value = value.encode() if isinstance(value, str) else serialise(value)
    return key + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    """Write a number with seven bits a byte."""
    value &= (1 << 64) - 1
    written = bytearray()
    while value > 0x7F:
        written.append(value & 0x7F | 0x80)
        value >>= 7
    written.append(value)
    return bytes(written)
