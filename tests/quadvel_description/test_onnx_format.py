"""Tests that our reader of ONNX files reads what the package `onnx` writes, and nothing else."""

from __future__ import annotations

import numpy as np
import onnx
import pytest

from quadvel_description import onnx_format
from quadvel_description.onnx_format import (
    MESSAGES,
    UNREAD,
    FormatError,
    message,
    parse,
    serialise,
)
from quadvel_estimator.learned import SHIPPED_MODEL
from quadvel_policy.policy_file import SHIPPED_POLICY

SHIPPED = [SHIPPED_POLICY, SHIPPED_MODEL]


def descriptor(kind: str):
    first, *rest = kind.split(".")
    found = getattr(onnx, first).DESCRIPTOR
    for name in rest:
        found = found.nested_types_by_name[name]
    return found


@pytest.mark.parametrize("kind", MESSAGES)
def test_fields_are_those_of_the_package_onnx(kind: str) -> None:
    ours = {(number, field.name, field.repeated) for number, field in MESSAGES[kind].items()}
    fields = descriptor(kind).fields
    assert ours == {(one.number, one.name, one.is_repeated) for one in fields}
    messages = {
        one.name: one.message_type.full_name.removeprefix("onnx.") for one in fields if one.message_type
    }
    read = {field.name: field.kind for field in MESSAGES[kind].values() if field.name in messages}
    assert all(read[name] in (UNREAD, full_name) for name, full_name in messages.items())


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_network_is_written_as_it_was_read(path) -> None:
    model = onnx.load(path)
    assert onnx.load_from_string(serialise(parse(path.read_bytes()))) == model


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("TensorProto", {"dims": [3, -1, 2**62]}),
        ("AttributeProto", {"f": 0.1, "i": -5, "s": b"\xff", "floats": [1.5, 2.5], "ints": [-1, 2**40]}),
        ("StringStringEntryProto", {"key": "µ", "value": ""}),
    ],
)
def test_numbers_and_texts_are_read(kind: str, values: dict) -> None:
    written = getattr(onnx, kind)(**values).SerializeToString()
    found = onnx_format._Reader(written).message(kind, 0, len(written))
    looked_at = {name: value for name, value in values.items() if name not in ("floats", "ints")}
    for name, value in looked_at.items():
        read = found.all(name) if isinstance(value, list) else found.one(name)
        assert read == (np.float32(value) if name == "f" else value)
    assert getattr(onnx, kind).FromString(serialise(found)).SerializeToString() == written


def test_dimensions_that_share_a_key_are_all_read() -> None:
    graph = message("GraphProto", initializer=message("TensorProto", name="W"))
    content = serialise(message("ModelProto", graph=graph)).replace(
        b"\x42\x01W", b"\x0a\x02\x07\x08\x42\x01W"
    )
    # The two outer lengths grow by what was put in.
    content = bytes([content[0], content[1] + 4, content[2], content[3] + 4]) + content[4:]
    assert parse(content).one("graph").one("initializer").all("dims") == [7, 8]


@pytest.mark.parametrize("field", ["graph", "ir_version"])
def test_a_single_field_that_occurs_twice_is_refused(field: str) -> None:
    """Some readers merge two graphs, others use the last one."""
    value = message("GraphProto") if field == "graph" else 8
    with pytest.raises(FormatError):
        parse(serialise(message("ModelProto", **{field: [value, value]})))


def test_broken_files_are_refused_or_written_as_onnx_reads_them() -> None:
    rng = np.random.default_rng(0)
    content = np.frombuffer(SHIPPED_MODEL.read_bytes(), np.uint8)
    keys = np.flatnonzero(content < 128)[:20_000]  # also lengths and names
    accepted = 0
    for i in range(120):
        broken = content.copy()
        broken[rng.choice(keys, 3)] = rng.integers(0, 256, 3)
        try:
            found = serialise(parse(broken[: None if i % 3 else rng.integers(len(broken))].tobytes()))
        except FormatError:
            continue
        accepted += 1
        assert serialise(parse(found)) == found
        assert onnx.load_from_string(found).ByteSize() == len(found)
    assert 20 < accepted < 100
