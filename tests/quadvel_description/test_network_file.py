"""Tests that a network file with anything but a data-flow graph is refused before it runs."""

from __future__ import annotations

import json
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import ModelProto, TensorProto, helper, numpy_helper

from quadvel_description.network_file import NetworkFileError, read_network
from quadvel_description.onnx_format import serialise
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.recurrent_network import RecurrentNetwork

Change = Callable[[ModelProto], object]


def network() -> ModelProto:
    """y = x W, as harmless as can be."""
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 4]) for name in "xy"]
    weights = numpy_helper.from_array(np.eye(4, dtype=np.float32), "W")
    product = helper.make_node("MatMul", ["x", "W"], ["y"], name="product")
    graph = helper.make_graph([product], "network", ends[:1], ends[1:], [weights])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def weights_elsewhere(model: ModelProto) -> None:
    """The data refer to a system file."""
    weights = model.graph.initializer[0]
    weights.ClearField("raw_data")
    weights.data_location = TensorProto.EXTERNAL
    weights.external_data.add(key="location", value="/etc/passwd")


def constant_elsewhere(model: ModelProto) -> None:
    """The same of a constant within a node."""
    constant = TensorProto(name="c", dims=[4], data_type=TensorProto.FLOAT)
    constant.data_location = TensorProto.EXTERNAL
    model.graph.node.append(helper.make_node("Constant", [], ["c"], value=constant))


def from_elsewhere(model: ModelProto) -> None:
    """An operator of a set that a library may bring along."""
    model.opset_import.append(helper.make_opsetid("com.evil", 1))
    model.graph.node[0].domain = "com.evil"


def branch(model: ModelProto) -> None:
    model.graph.node.append(
        helper.make_node("If", ["x"], ["z"], then_branch=network().graph, else_branch=network().graph)
    )


def hidden_graph(model: ModelProto) -> None:
    """A subgraph in an operator that takes none."""
    model.graph.node[0].attribute.append(helper.make_attribute("body", network().graph))


def function(model: ModelProto) -> None:
    """MatMul as the file itself defines it."""
    opset = [helper.make_opsetid("", 17)]
    body = [helper.make_node("Identity", ["a"], ["c"])]
    model.functions.append(helper.make_function("", "MatMul", ["a", "b"], ["c"], body, opset))


def training(model: ModelProto) -> None:
    model.training_info.add()


def sparse(model: ModelProto) -> None:
    model.graph.sparse_initializer.add().dims.extend([10**9, 10**9])


def opset(version: int) -> Change:
    return lambda model: setattr(model.opset_import[0], "version", version)


def operator(name: str) -> Change:
    return lambda model: setattr(model.graph.node[0], "op_type", name)


def shape(*dims: int) -> Change:
    return lambda model: model.graph.initializer[0].MergeFrom(TensorProto(dims=dims))


def kind(number: int) -> Change:
    return lambda model: setattr(model.graph.initializer[0], "data_type", number)


def padded(model: ModelProto) -> None:
    model.graph.node[0].op_type = "Conv"
    model.graph.node[0].attribute.append(helper.make_attribute("pads", [0, 10**9]))


def many(model: ModelProto) -> None:
    model.graph.node.extend([helper.make_node("Identity", ["x"], [f"x{i}"]) for i in range(50_000)])


def test_a_set_of_operators_that_no_node_uses_is_harmless(tmp_path: Path) -> None:
    model = network()
    model.opset_import.append(helper.make_opsetid("ai.onnx.ml", 2))
    onnx.save(model, tmp_path / "good.onnx")
    read_network(tmp_path / "good.onnx")
    model.graph.node[0].domain = "ai.onnx.ml"
    onnx.save(model, tmp_path / "bad.onnx")
    with pytest.raises(NetworkFileError, match=r"operator 'ai\.onnx\.ml\.MatMul'"):
        read_network(tmp_path / "bad.onnx")


def test_expanding_to_the_shape_of_another_value_is_allowed(tmp_path: Path) -> None:
    model = network()
    model.graph.node.extend(
        [helper.make_node("Shape", ["x"], ["shape"]), helper.make_node("Expand", ["x", "shape"], ["z"])]
    )
    onnx.save(model, tmp_path / "good.onnx")
    read_network(tmp_path / "good.onnx")


def test_a_harmless_network_is_read_as_it_is(tmp_path: Path) -> None:
    onnx.save(network(), tmp_path / "good.onnx")
    assert serialise(read_network(tmp_path / "good.onnx")) == network().SerializeToString()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (weights_elsewhere, "tensor 'W' lies in another file, expected all data in this one"),
        (constant_elsewhere, "tensor 'c' lies in another file"),
        (operator("Loop"), "operator 'Loop' of node 'product' is not one of those that are run: Abs Acos"),
        (
            operator("Expand"),
            "operator 'Expand' of node 'product' expands to .'W'., expected the output of a Shape",
        ),
        (padded, "operator 'Conv' of node 'product' has the attribute pads .0, 1000000000."),
        (branch, "operator 'If'"),
        (from_elsewhere, "operators come from the sets ai.onnx 17, com.evil 1, expected ai.onnx 11 to 21"),
        (lambda model: setattr(model.graph.node[0], "domain", "com.evil"), "operator 'com.evil.MatMul'"),
        (opset(10), "from the sets ai.onnx 10, expected"),
        (opset(22), "from the sets ai.onnx 22, expected"),
        (lambda model: model.ClearField("opset_import"), "from the sets none, expected"),
        (hidden_graph, "has a part AttributeProto.g, expected none"),
        (function, "has a part ModelProto.functions, expected none"),
        (training, "has a part ModelProto.training_info, expected none"),
        (sparse, "has a part GraphProto.sparse_initializer, expected none"),
        (many, "has more than 50000 parts, expected fewer"),
        (shape(10**6, 10**6), r"tensor 'W' has the shape .* expected at most 4000000 numbers"),
        (shape(-1), "tensor 'W' has the shape .* expected at most 4000000 numbers"),
        (kind(TensorProto.STRING), "tensor 'W' is of type 8, expected BOOL, FLOAT, INT32, INT64"),
    ],
)
def test_what_is_more_than_numbers_is_refused_by_name(tmp_path: Path, change: Change, sentence: str) -> None:
    model = network()
    change(model)
    (tmp_path / "hostile.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(NetworkFileError, match=rf"hostile\.onnx: .*{sentence}"):
        read_network(tmp_path / "hostile.onnx")
    with pytest.raises(NetworkFileError, match=rf"hostile\.onnx: .*{sentence}"):
        RecurrentNetwork(tmp_path / "hostile.onnx", "aliengo", {"y": 4})


def zipped(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("../../etc/passwd", "root")


@pytest.mark.parametrize(
    "write",
    [
        zipped,
        lambda path: path.write_bytes(pickle.dumps({"weights": [1.0]})),
        lambda path: path.write_bytes(network().SerializeToString()[:-40]),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_text("policy"),
    ],
    ids=["zip", "pickle", "cut off", "empty", "text"],
)
def test_another_file_is_refused(tmp_path: Path, write: Callable[[Path], object]) -> None:
    write(tmp_path / "other.onnx")
    with pytest.raises(NetworkFileError, match=r"other\.onnx: is not an ONNX network, or not a whole one"):
        read_network(tmp_path / "other.onnx")


def test_a_text_that_can_not_be_read_is_refused(tmp_path: Path) -> None:
    content = network().SerializeToString().replace(b"product", b"pr\xffduct")
    (tmp_path / "odd.onnx").write_bytes(content)
    with pytest.raises(NetworkFileError, match=r"GraphProto.node with a text that is not UTF-8"):
        read_network(tmp_path / "odd.onnx")


def test_a_file_too_large_to_be_run_in_time_is_refused_unread(tmp_path: Path) -> None:
    with (tmp_path / "large.onnx").open("wb") as file:
        file.truncate(10**12)  # a hole, that takes no room
    with pytest.raises(NetworkFileError, match=r"large\.onnx: has 1000000\.0 MB, expected at most 16\.0 MB"):
        read_network(tmp_path / "large.onnx")


def test_what_the_format_does_not_know_does_not_reach_who_runs_it(tmp_path: Path) -> None:
    unknown = b"\xfa\x7f\x04evil"  # field 2047
    (tmp_path / "newer.onnx").write_bytes(network().SerializeToString() + unknown)
    assert b"evil" not in serialise(read_network(tmp_path / "newer.onnx"))


def test_a_file_of_countless_values_is_refused(tmp_path: Path) -> None:
    (tmp_path / "many.onnx").write_bytes(network().SerializeToString() + b"\xfa\x7f\x00" * 600_000)
    with pytest.raises(NetworkFileError, match=r"many\.onnx: has more than 500000 values, expected fewer"):
        read_network(tmp_path / "many.onnx")


@pytest.mark.parametrize("path", ["/dev/zero", "/proc/self/mem", "/"])
def test_what_is_no_file_is_not_opened(path: str) -> None:
    with pytest.raises(NetworkFileError, match=r"no such file|can't be read|not an ONNX network"):
        read_network(Path(path))


def test_a_memory_that_would_fill_the_machine_is_refused(tmp_path: Path) -> None:
    """Its shape is written in few bytes."""
    dims = [10**6, 10**6, 10**6]
    memory = [helper.make_tensor_value_info(name, TensorProto.FLOAT, dims) for name in ("h_in", "c_in")]
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, dims) for name in ("h_out", "c_out")]
    model = network()
    model.graph.input[0].name = model.graph.node[0].input[0] = "obs"
    model.graph.input.extend(memory)
    model.graph.output.extend(ends)
    for name in "hc":
        model.graph.node.append(helper.make_node("Identity", [f"{name}_in"], [f"{name}_out"]))
    metadata = {"schema": 1, "joint_names": list(JOINT_NAMES), "state_shape": dims}
    helper.set_model_props(model, {"quadvel": json.dumps(metadata)})
    onnx.save(model, tmp_path / "vast.onnx")
    with pytest.raises(NetworkFileError, match=r"shape of input h_in is .* expected 'at most 10000 numbers'"):
        RecurrentNetwork(tmp_path / "vast.onnx", "aliengo", {"y": 4})
