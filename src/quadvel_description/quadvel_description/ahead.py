"""Split of a recurrent ONNX network: the part that needs no observation can run early.

For an LSTM this part is the product of memory and recurrent weights, two thirds of a step. Nothing
is approximated; only the order of summation changes: [x h] [W; U] = x W + h U.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import attrs
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from .onnx_format import FLOAT32, Message, float_value, message, serialise, stored_tensor

ProductTerm = tuple[str, NDArray[np.float32]]
"""Name of a row vector x (1, k), and the matrix W (k, n) of the product x W."""
Shapes = dict[str, list[int]]
"""Shapes of float32 values by name."""
_DEFAULT_GEMM_ATTRIBUTES = {"alpha": 1.0, "beta": 1.0, "transA": 0}  # of a Gemm that is x W + b


def split_network(model: Message, late_input: str) -> tuple[Message, Message] | None:
    """Split a network into a part that runs before an input is known, and the rest.

    Both parts keep the names of the model's inputs and outputs. The outputs of the first part, all
    of them float32, are additional inputs of the second.

    Args:
        model: The network.
        late_input: Name of the input that is known last.

    Returns:
        First part and rest. None if a split gains nothing: no product, written as Gemm of a Concat
        with an initializer, has both terms that depend on the input and terms that do not.
    """
    graph = model.one("graph")
    nodes, inputs = graph.all("node"), graph.all("input")
    memories = [value for value in inputs if value.one("name") != late_input]
    late = _dependents(nodes, {late_input})
    early = _dependents(nodes, {value.one("name") for value in memories}) - late
    shapes = _infer_shapes(model, early | late)
    split_nodes, weights = _split_products(graph, late, shapes)
    if not weights:
        return None
    early = _dependents(split_nodes, {value.one("name") for value in memories}) - late
    known = {value.one("name") for value in inputs}
    used_late = (
        name for node in split_nodes if not early.issuperset(node.all("output")) for name in node.all("input")
    )
    names = dict.fromkeys(name for name in used_late if name in early - known and name in shapes)
    handed_over = [float_value(name, shapes[name]) for name in names]
    return (
        _extract(model, split_nodes, weights, memories, handed_over),
        _extract(model, split_nodes, weights, [*inputs, *handed_over], graph.all("output")),
    )


def _dependents(nodes: Iterable[Message], names: set[str]) -> set[str]:
    """Return `names` and the names of all values that are computed from any of them."""
    made = set(names)
    for node in nodes:
        if made.intersection(node.all("input")):
            made.update(node.all("output"))
    return made


def _infer_shapes(model: Message, names: set[str]) -> Shapes:
    """Return the shapes of those values that are float32 and of a fixed shape."""
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.log_severity_level = 4
    outputs = [message("ValueInfoProto", name=name) for name in sorted(names - {""})]
    graph = attrs.evolve(model.one("graph"), fields=model.one("graph").fields | {"output": outputs})
    asking = attrs.evolve(model, fields=model.fields | {"graph": [graph]})
    session = onnxruntime.InferenceSession(serialise(asking), options, providers=["CPUExecutionProvider"])
    return {
        value.name: value.shape
        for value in session.get_outputs()
        if value.type == "tensor(float)" and all(isinstance(length, int) for length in value.shape)
    }


def _split_products(graph: Message, late: set[str], shapes: Shapes) -> tuple[list[Message], list[Message]]:
    """Split every product that can be split; add the shapes of the new values to `shapes`.

    Returns:
        All nodes, and the weights of the split products.
    """
    nodes: list[Message] = []
    weights: list[Message] = []
    for node in graph.all("node"):
        terms = _product_terms(graph, node, shapes)
        early = [term for term in terms if term[0] not in late]
        added = node.all("input")[2:]
        if not 0 < len(early) < len(terms) or late.intersection(added):
            nodes.append(node)
            continue
        output = node.one("output")
        ahead = f"{output}/ahead"
        shapes[ahead] = [1, early[0][1].shape[1]]
        rest = [term for term in terms if term[0] in late]
        for part, more, result in ((early, added, ahead), (rest, [ahead], output)):
            nodes += _product_nodes([name for name, _ in part], more, result)
            weights.append(stored_tensor(f"{result}/weights", np.concatenate([matrix for _, matrix in part])))
    return nodes, weights


def _product_terms(graph: Message, node: Message, shapes: Shapes) -> list[ProductTerm]:
    """Return the terms of a product of a Concat with an initializer; empty for other nodes."""
    attributes = {one.one("name"): one.one("f", one.one("i", 0)) for one in node.all("attribute")}
    if node.one("op_type") != "Gemm" or any(
        attributes.get(name, value) != value for name, value in _DEFAULT_GEMM_ATTRIBUTES.items()
    ):
        return []
    joined = _concatenated_values(graph, node.all("input")[0])
    matrix = _stored_matrix(graph, node.all("input")[1])
    if len(joined) < 2 or matrix is None:
        return []
    matrix = matrix.T if attributes.get("transB") else matrix
    widths = [shapes[name][1] if len(shapes.get(name, ())) == 2 else 0 for name in joined]
    if 0 in widths or sum(widths) != len(matrix):
        return []
    return list(zip(joined, np.split(matrix, np.cumsum(widths)[:-1]), strict=True))


def _stored_matrix(graph: Message, name: str) -> NDArray[np.float32] | None:
    """Return an initializer if it is a matrix of float32 in `raw_data`, else None."""
    tensor = next((one for one in graph.all("initializer") if one.one("name") == name), None)
    if tensor is None or tensor.one("data_type") != FLOAT32 or len(tensor.all("dims")) != 2:
        return None
    values = np.frombuffer(tensor.one("raw_data", b""), np.uint8)
    rows, columns = tensor.all("dims")
    return values.view("<f4").reshape(rows, columns) if values.size == 4 * rows * columns else None


def _concatenated_values(graph: Message, name: str) -> list[str]:
    """Return the values that `name` is concatenated from, through nested Concats; else itself."""
    joins = {
        output: node.all("input")
        for node in graph.all("node")
        if node.one("op_type") == "Concat"
        for output in node.all("output")
    }
    parts: list[str] = []
    waiting = [name]
    while waiting:
        one = waiting.pop()
        if one in joins:
            waiting += reversed(joins[one])
        else:
            parts.append(one)
    return parts


def _product_nodes(names: Sequence[str], added: Sequence[str], output: str) -> list[Message]:
    """Return nodes that sum the products of the values `names`, and `added`."""
    axis = message("AttributeProto", name="axis", i=1, type=2)
    joined, weights = f"{output}/joined", f"{output}/weights"
    return [
        message("NodeProto", input=list(names), output=joined, op_type="Concat", attribute=axis),
        message("NodeProto", input=[joined, weights, *added], output=output, op_type="Gemm"),
    ]


def _extract(
    model: Message,
    nodes: Sequence[Message],
    weights: Sequence[Message],
    inputs: list[Message],
    outputs: list[Message],
) -> Message:
    """Return the network of the nodes, initializers and `weights` that lead to the outputs."""
    given = {value.one("name") for value in inputs}
    wanted = {value.one("name") for value in outputs}
    needed = []
    for node in reversed(nodes):
        if wanted.intersection(node.all("output")) - given:
            wanted.update(node.all("input"))
            needed.append(node)
    stored = [one for one in (*model.one("graph").all("initializer"), *weights) if one.one("name") in wanted]
    graph = message(
        "GraphProto", node=needed[::-1], name="part", initializer=stored, input=inputs, output=outputs
    )
    return attrs.evolve(model, fields=model.fields | {"graph": [graph]})
