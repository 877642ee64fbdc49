"""Tests of split networks: the parts compute what the whole network computes."""

from __future__ import annotations

import numpy as np
import onnxruntime
import pytest
from onnx import ModelProto, TensorProto, helper, numpy_helper

from quadvel_description.ahead import split_network
from quadvel_description.onnx_format import parse, serialise

MEMORY = 4
INPUTS = {"obs": (1, 3), "h_in": (1, 1, 2 * MEMORY), "c_in": (1, 1, MEMORY)}


def network(
    order: tuple[str, ...] = ("obs", "h", "kept", "bent"), nested: bool = False, **gemm: float
) -> ModelProto:
    """A product of `order` put together, where h and kept are halves of h_in and bent is made of obs; `gemm`: its attributes.

    nested: all but the first are put together first.
    """
    rng = np.random.default_rng(0)
    widths = {"obs": 3, "bent": 3, "h": MEMORY, "kept": MEMORY}
    weight = rng.normal(size=(sum(widths[name] for name in order), MEMORY)).astype(np.float32)
    constants = {
        "W": np.ascontiguousarray(weight.T) if gemm.get("transB") else weight,
        "b": rng.normal(size=MEMORY).astype(np.float32),
        "halves": np.array([MEMORY, MEMORY]),
        "flat": np.array([1, -1]),
        "deep": np.array([1, 1, -1]),
    }
    joining = [helper.make_node("Concat", order, ["joined"], axis=1)]
    if nested:
        joining = [
            helper.make_node("Concat", order[1:], ["others"], axis=1),
            helper.make_node("Concat", [order[0], "others"], ["joined"], axis=1),
        ]
    nodes = [
        helper.make_node("Reshape", ["h_in", "flat"], ["memory"]),
        helper.make_node("Split", ["memory", "halves"], ["h", "kept"], axis=1),
        helper.make_node("Tanh", ["obs"], ["bent"]),
        *joining,
        helper.make_node("Gemm", ["joined", "W", "b"], ["sum"], **gemm),
        helper.make_node("Sigmoid", ["sum"], ["actions"]),
        helper.make_node("Concat", ["actions", "kept"], ["after"], axis=1),
        helper.make_node("Reshape", ["after", "deep"], ["h_out"]),
        helper.make_node("Tanh", ["c_in"], ["c_out"]),
    ]
    outputs = {"actions": (1, MEMORY), "h_out": INPUTS["h_in"], "c_out": INPUTS["c_in"]}
    inputs, outputs = (
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in ends.items()]
        for ends in (INPUTS, outputs)
    )
    stored = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "network", inputs, outputs, stored)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)


def split(model: ModelProto) -> list[bytes] | None:
    parts = split_network(parse(model.SerializeToString()), "obs")
    return parts and [serialise(part) for part in parts]


def run(model: bytes, given: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    names = [end.name for end in session.get_outputs()]
    return dict(
        zip(
            names,
            session.run(names, {end.name: given[end.name] for end in session.get_inputs()}),
            strict=True,
        )
    )


@pytest.mark.parametrize(
    "model",
    [
        network(),
        network(("h", "bent", "kept", "obs")),
        network(("obs", "h")),
        network(transB=1),
        network(nested=True),
    ],
    ids=["mixed", "another order", "two terms", "transposed weights", "put together in two steps"],
)
def test_both_parts_together_are_the_network(model: ModelProto) -> None:
    rng = np.random.default_rng(1)
    given = {name: rng.normal(size=shape).astype(np.float32) for name, shape in INPUTS.items()}
    parts = split(model)
    assert parts is not None
    ahead = run(parts[0], {name: value for name, value in given.items() if name != "obs"})
    found, expected = run(parts[1], given | ahead), run(model.SerializeToString(), given)
    assert list(found) == list(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, atol=1e-6)


@pytest.mark.parametrize(
    "model",
    [network(("obs", "bent")), network(("h", "kept")), network(alpha=0.5)],
    ids=["all awaits", "nothing awaits", "a scaled product"],
)
def test_a_network_without_a_product_of_both_kinds_stays_whole(model: ModelProto) -> None:
    assert split(model) is None


def test_products_of_deeply_nested_parts_are_followed() -> None:
    """Deeper than Python calls functions within each other."""
    model = network()
    joining = next(i for i, node in enumerate(model.graph.node) if node.op_type == "Concat")
    model.graph.node[joining].output[0] = "joined0"
    deep = [helper.make_node("Concat", [f"joined{i}"], [f"joined{i + 1}"], axis=1) for i in range(1500)]
    deep[-1].output[0] = "joined"
    nodes = [*model.graph.node[: joining + 1], *deep, *model.graph.node[joining + 1 :]]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    assert split(model) is not None
