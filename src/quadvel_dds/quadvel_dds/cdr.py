"""Serialisers and deserialisers in XCDR1 (little endian), one pair of compiled functions per message type.

The code is generated, because a message of the control loop is written and read up to a thousand times a
second: runs of scalars, nested ones included, become one `struct` call, numeric arrays one copy. Field
descriptions are those of `rosbags`. What a message class looks like is decided in `messages`; this module
knows only its slots (`_name`).
"""

from __future__ import annotations

import array
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

HEADER = b"\x00\x01\x00\x00"  # encapsulation: plain CDR, little endian, no options
FORMATS = {
    "bool": "?", "byte": "c", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
NOT_NUMERIC = ("bool", "byte", "string")

Fields = list[tuple[str, Any]]
Describe = Callable[[str], tuple[type, Fields]]


def is_numeric(description: Any) -> bool:
    """Whether a field is an array or a sequence that is held as one block of numbers."""
    kind, detail = description
    if kind not in (Nodetype.ARRAY, Nodetype.SEQUENCE) or detail[0][0] != Nodetype.BASE:
        return False
    return detail[0][1][0] not in NOT_NUMERIC


class _Generator(ABC):
    """Walks the fields of a type in order, knows what is sure about the alignment, and collects scalar runs.

    The position is known to be `remainder` modulo `modulus`; alignment is relative to the end of the header.
    """

    def __init__(self, describe: Describe) -> None:
        self.describe = describe
        self.names: dict[str, Any] = {"array": array.array, "fromarray": np.frombuffer, "new": object.__new__}
        self.names["length_error"] = length_error
        self.lines: list[str] = []
        self.depth = 1
        self.remainder, self.modulus = 0, 8
        self.run_format, self.run_targets = "", list[str]()

    def emit(self, line: str) -> None:
        self.lines.append("    " * self.depth + line)

    def constant(self, prefix: str, value: Any) -> str:
        name = f"{prefix}{len(self.names)}"
        self.names[name] = value
        return name

    def local(self) -> str:
        return self.constant("v", None)

    def advance(self, size: int) -> None:
        self.remainder = (self.remainder + size) % self.modulus

    def forget(self, modulus: int = 1) -> None:
        self.remainder, self.modulus = 0, modulus

    def scalar(self, format_: str, target: str) -> None:
        """Add one scalar to the current run, with the padding in front of it."""
        size = struct.calcsize(format_)
        if self.modulus % size:
            self.flush()
            self.pad(size)
            self.forget(size)
        padding = -self.remainder % size
        self.run_format += "x" * padding + format_
        self.run_targets.append(target)
        self.advance(padding + size)

    def align(self, size: int) -> None:
        """Align the current position where no scalar follows."""
        self.flush()
        if self.modulus % size == 0:
            if padding := -self.remainder % size:
                self.skip(padding)
                self.advance(padding)
        else:
            self.pad(size)
            self.forget(size)

    def flush(self) -> None:
        if self.run_format:
            packer = self.constant("s", struct.Struct("<" + self.run_format))
            self.transfer(packer, self.run_targets)
            self.run_format, self.run_targets = "", []

    def message(self, typename: str, variable: str) -> None:
        for name, description in self.describe(typename)[1]:
            self.field(f"{variable}._{name}", description)

    def field(self, target: str, description: Any) -> None:
        kind, detail = description
        if kind == Nodetype.NAME:
            self.nested(detail, target)
        elif kind == Nodetype.BASE:
            if detail[0] == "string":
                self.string(target)
            else:
                self.scalar(FORMATS[detail[0]], target)
        else:
            count = detail[1] if kind == Nodetype.ARRAY else None
            if is_numeric(description):
                self.numbers(target, FORMATS[detail[0][1][0]], count)
            else:
                self.items(target, detail[0], count)

    # What writing and reading do differently.
    @abstractmethod
    def pad(self, size: int) -> None: ...

    @abstractmethod
    def skip(self, padding: int) -> None: ...

    @abstractmethod
    def transfer(self, packer: str, targets: list[str]) -> None: ...

    @abstractmethod
    def nested(self, typename: str, target: str) -> None: ...

    @abstractmethod
    def string(self, target: str) -> None: ...

    @abstractmethod
    def numbers(self, target: str, format_: str, count: int | None) -> None: ...

    @abstractmethod
    def items(self, target: str, description: Any, count: int | None) -> None: ...

    def compile(self, signature: str, result: str) -> Callable[..., Any]:
        self.flush()
        self.emit(result)
        exec("\n".join([f"def {signature}:", *self.lines]), self.names)
        return self.names[signature.split("(")[0]]


class _Writer(_Generator):
    """Generates `write(m, b)`: append message `m` to bytearray `b`, whose content starts at `o`."""

    def pad(self, size: int) -> None:
        self.emit(f"b += bytes((o - len(b)) % {size})")

    def skip(self, padding: int) -> None:
        self.emit(f"b += {bytes(padding)!r}")

    def transfer(self, packer: str, targets: list[str]) -> None:
        self.emit(f"b += {packer}.pack({', '.join(targets)})")

    def nested(self, typename: str, target: str) -> None:
        self.message(typename, target)

    def string(self, target: str) -> None:
        text = self.local()
        self.emit(f"{text} = {target}.encode()")
        self.scalar("I", f"len({text}) + 1")
        self.flush()
        self.emit(f"b += {text}; b += b'\\0'")
        self.forget()

    def numbers(self, target: str, format_: str, count: int | None) -> None:
        size = struct.calcsize(format_)
        if count is None:
            self.scalar("I", f"len({target})")
            self.flush()
            self.emit(f"if len({target}):")
            self.depth += 1
            self.align(size)
            self.emit(f"b += {target}.tobytes()")
            self.depth -= 1
            self.forget(min(4, size))
        else:
            self.align(size)
            self.emit(f"if len({target}) != {count}: raise length_error({target!r}, {count}, len({target}))")
            self.emit(f"b += {target}.tobytes()")
            self.advance(count * size)

    def items(self, target: str, description: Any, count: int | None) -> None:
        if count is None:
            self.scalar("I", f"len({target})")
        else:
            self.emit(f"if len({target}) != {count}: raise length_error({target!r}, {count}, len({target}))")
        self.flush()
        item = self.local()
        self.emit(f"for {item} in {target}:")
        self.depth += 1
        self.forget()
        self.field(item, description)
        self.flush()
        self.depth -= 1
        self.forget()


class _Reader(_Generator):
    """Generates `read(d, p)`: the message at position `p` of bytes `d`, whose content starts at `o`."""

    def pad(self, size: int) -> None:
        self.emit(f"p += (o - p) % {size}")

    def skip(self, padding: int) -> None:
        self.emit(f"p += {padding}")

    def transfer(self, packer: str, targets: list[str]) -> None:
        self.emit(f"{', '.join(targets)}, = {packer}.unpack_from(d, p)")
        self.emit(f"p += {self.names[packer].size}")

    def nested(self, typename: str, target: str) -> None:
        variable = self.local()
        self.emit(f"{target} = {variable} = new({self.constant('c', self.describe(typename)[0])})")
        self.message(typename, variable)

    def string(self, target: str) -> None:
        length = self.local()
        self.scalar("I", length)
        self.flush()
        self.emit(f"{target} = str(d[p:p + {length} - 1], 'utf-8'); p += {length}")
        self.forget()

    def numbers(self, target: str, format_: str, count: int | None) -> None:
        size = struct.calcsize(format_)
        if count is None:
            length = self.local()
            self.scalar("I", length)
            self.flush()
            self.emit(f"{target} = array({format_!r})")
            self.emit(f"if {length}:")
            self.depth += 1
            self.align(size)
            self.emit(f"{target}.frombytes(d[p:p + {length} * {size}]); p += {length} * {size}")
            self.depth -= 1
            self.forget(min(4, size))
        else:
            self.align(size)
            dtype = self.constant("t", np.dtype(format_))
            self.emit(f"{target} = fromarray(d, {dtype}, {count}, p).copy(); p += {count * size}")
            self.advance(count * size)

    def items(self, target: str, description: Any, count: int | None) -> None:
        length = self.local()
        if count is None:
            self.scalar("I", length)
            self.flush()
        else:
            self.flush()
            self.emit(f"{length} = {count}")
        values, item = self.local(), self.local()
        self.emit(f"{target} = {values} = []")
        self.emit(f"for _ in range({length}):")
        self.depth += 1
        self.forget()
        self.field(item, description)
        self.flush()
        self.emit(f"{values}.append({item})")
        self.depth -= 1
        self.forget()


def length_error(target: str, expected: int, found: int) -> ValueError:
    return ValueError(f"field '{target[3:].replace('._', '.')}' holds {found} values, expected {expected}")


def make_writer(typename: str, describe: Describe) -> Callable[..., None]:
    """Function `write(m, b, o=4)` for a type, see `_Writer`."""
    generator = _Writer(describe)
    generator.message(typename, "m")
    return generator.compile("write(m, b, o=4)", "return")


def make_reader(typename: str, describe: Describe) -> Callable[..., Any]:
    """Function `read(d, p=4, o=4)` for a type, see `_Reader`; struct.error or ValueError on bad data."""
    generator = _Reader(describe)
    variable = generator.local()
    generator.emit(f"{variable} = new({generator.constant('c', describe(typename)[0])})")
    generator.message(typename, variable)
    generator.flush()
    generator.emit("if p > len(d): raise ValueError(f'the content ends at byte {p}, the data at {len(d)}')")
    return generator.compile("read(d, p=4, o=4)", f"return {variable}")
