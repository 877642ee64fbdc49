"""Split of a recurrent ONNX network: the part that needs no observation can run early.

For an LSTM this part is the product of memory and recurrent weights, two thirds of a step. Nothing
is approximated; only the order of summation changes: [x h] [W; U] = x W + h U.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import AttributeProto, GraphProto, ModelProto, NodeProto, TensorProto, helper, numpy_helper

ProductTerm = tuple[str, NDArray[np.float32]]
"""Name of a row vector x (1, k), and the matrix W (k, n) of the product x W."""
_DEFAULT_GEMM_ATTRIBUTES = {"alpha": 1.0, "beta": 1.0, "transA": 0}  # of a Gemm that is x W + b


def split_network(model: ModelProto, late_input: str) -> tuple[ModelProto, ModelProto] | None:
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
    subgraphs = (one.type == AttributeProto.GRAPH for node in model.graph.node for one in node.attribute)
    if any(subgraphs) or model.graph.sparse_initializer or model.graph.quantization_annotation:
        return None  # dependencies are not visible in the names of the nodes' inputs
    whole = onnx.shape_inference.infer_shapes(model)
    inputs = [value.name for value in whole.graph.input]
    if not _split_products(whole.graph, late_input):
        return None
    early = _dependents(whole.graph, set(inputs) - {late_input}) - _dependents(whole.graph, {late_input})
    used_late = (
        name for node in whole.graph.node if not early.issuperset(node.output) for name in node.input
    )
    handed_over = list(dict.fromkeys(name for name in used_late if name in early and name not in inputs))
    parts = onnx.utils.Extractor(whole)
    return (
        parts.extract_model([name for name in inputs if name != late_input], handed_over),
        parts.extract_model([*inputs, *handed_over], [value.name for value in whole.graph.output]),
    )


def _dependents(graph: GraphProto, names: set[str]) -> set[str]:
    """Return `names` and the names of all values that are computed from any of them."""
    made = set(names)
    for node in graph.node:
        if made.intersection(node.input):
            made.update(node.output)
    return made


def _split_products(graph: GraphProto, late_input: str) -> bool:
    """Split every product of `graph` that can be split; return whether there was one."""
    late = _dependents(graph, {late_input})
    nodes: list[NodeProto] = []
    for node in graph.node:
        terms = _product_terms(graph, node)
        early = [term for term in terms if term[0] not in late]
        if not 0 < len(early) < len(terms) or late.intersection(node.input[2:]):
            nodes.append(node)
            continue
        ahead = f"{node.output[0]}/ahead"
        nodes += _product_nodes(graph, early, node.input[2:], ahead)
        nodes += _product_nodes(graph, [term for term in terms if term[0] in late], [ahead], node.output[0])
    found = len(nodes) > len(graph.node)
    del graph.node[:]
    graph.node.extend(_needed_nodes(nodes, {end.name for end in graph.output}))
    return found


def _needed_nodes(nodes: Sequence[NodeProto], wanted: set[str]) -> list[NodeProto]:
    """Return the nodes, in their order, on which the `wanted` values depend."""
    kept = []
    for node in reversed(nodes):
        if wanted.intersection(node.output):
            wanted.update(node.input)
            kept.append(node)
    return kept[::-1]


def _product_terms(graph: GraphProto, node: NodeProto) -> list[ProductTerm]:
    """Return the terms of a product of a Concat with an initializer; empty for other nodes."""
    attributes = {one.name: helper.get_attribute_value(one) for one in node.attribute}
    if node.op_type != "Gemm" or any(
        attributes.get(name, value) != value for name, value in _DEFAULT_GEMM_ATTRIBUTES.items()
    ):
        return []
    joined = _concatenated_values(graph, node.input[0])
    weight = next((one for one in graph.initializer if one.name == node.input[1]), None)
    if len(joined) < 2 or weight is None:
        return []
    matrix = numpy_helper.to_array(weight)
    matrix = matrix.T if attributes.get("transB") else matrix
    known = {value.name: value.type.tensor_type.shape.dim for value in [*graph.input, *graph.value_info]}
    widths = [known[name][1].dim_value if len(known.get(name, ())) == 2 else 0 for name in joined]
    if 0 in widths or sum(widths) != len(matrix):
        return []
    return list(zip(joined, np.split(matrix, np.cumsum(widths)[:-1]), strict=True))


def _concatenated_values(graph: GraphProto, name: str) -> list[str]:
    """Return the values that `name` is concatenated from, through nested Concats; else itself."""
    joins = {output: node.input for node in graph.node if node.op_type == "Concat" for output in node.output}
    parts: list[str] = []
    waiting = [name]
    while waiting:
        one = waiting.pop()
        if one in joins:
            waiting += reversed(joins[one])
        else:
            parts.append(one)
    return parts


def _product_nodes(
    graph: GraphProto, terms: Sequence[ProductTerm], added: Sequence[str], output: str
) -> list[NodeProto]:
    """Return nodes that sum `terms` and `added`; add weights and shape of `output` to `graph`."""
    weight = np.concatenate([matrix for _, matrix in terms])
    names = joined, weights = f"{output}/joined", f"{output}/weights"
    graph.initializer.append(numpy_helper.from_array(weight, weights))
    graph.value_info.append(helper.make_tensor_value_info(output, TensorProto.FLOAT, (1, weight.shape[1])))
    return [
        helper.make_node("Concat", [name for name, _ in terms], [joined], axis=1),
        helper.make_node("Gemm", [*names, *added], [output]),
    ]
