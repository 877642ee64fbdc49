"""Cuts a network with a memory in two: what needs the memory alone can be computed before the observation comes.

In an LSTM that is the memory times the recurrent weights, two thirds of a step. Nothing is approximated; only
the order of sums changes. What the network means, and when its parts run, is the caller's matter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import AttributeProto, GraphProto, ModelProto, NodeProto, TensorProto, helper, numpy_helper

Term = tuple[str, NDArray[np.float32]]
"""The name of a row vector x (1, k) and the matrix (k, n) that it is multiplied with."""
_PLAIN = {"alpha": 1.0, "beta": 1.0, "transA": 0}  # attributes of a Gemm that is x W + b


def cut(model: ModelProto, awaited: str) -> tuple[ModelProto, ModelProto] | None:
    """`model` as (ahead, rest): the first does without the input `awaited`, the second has the less to do.

    Both keep the names of the model's inputs and outputs; what ahead hands over, float32 all, are its outputs and
    further inputs of rest. None where there is nothing to gain: no product, written as Gemm of a Concat with an initializer, has
    terms that await the input beside terms that do not.
    """
    subgraphs = (one.type == AttributeProto.GRAPH for node in model.graph.node for one in node.attribute)
    if any(subgraphs) or model.graph.sparse_initializer or model.graph.quantization_annotation:
        return None  # can't be taken apart by the names that nodes give
    whole = onnx.shape_inference.infer_shapes(model)
    inputs = [value.name for value in whole.graph.input]
    if not _cut_products(whole.graph, awaited):
        return None
    early = _made_of(whole.graph, set(inputs) - {awaited}) - _made_of(whole.graph, {awaited})
    used_late = (
        name for node in whole.graph.node if not early.issuperset(node.output) for name in node.input
    )
    handed_over = list(dict.fromkeys(name for name in used_late if name in early and name not in inputs))
    parts = onnx.utils.Extractor(whole)
    return (
        parts.extract_model([name for name in inputs if name != awaited], handed_over),
        parts.extract_model([*inputs, *handed_over], [value.name for value in whole.graph.output]),
    )


def _made_of(graph: GraphProto, names: set[str]) -> set[str]:
    """`names` and all that is computed from any of them."""
    made = set(names)
    for node in graph.node:
        if made.intersection(node.input):
            made.update(node.output)
    return made


def _cut_products(graph: GraphProto, awaited: str) -> bool:
    """Cut in `graph` every product that can be; whether there was one."""
    late = _made_of(graph, {awaited})
    nodes: list[NodeProto] = []
    for node in graph.node:
        terms = _terms(graph, node)
        early = [term for term in terms if term[0] not in late]
        if not 0 < len(early) < len(terms) or late.intersection(node.input[2:]):
            nodes.append(node)
            continue
        ahead = f"{node.output[0]}/ahead"
        nodes += _product(graph, early, node.input[2:], ahead)
        nodes += _product(graph, [term for term in terms if term[0] in late], [ahead], node.output[0])
    found = len(nodes) > len(graph.node)
    del graph.node[:]
    graph.node.extend(_of_use(nodes, {end.name for end in graph.output}))
    return found


def _of_use(nodes: Sequence[NodeProto], wanted: set[str]) -> list[NodeProto]:
    """Those of `nodes`, which are in order, that `wanted` values are made by: what was put together for a product is not."""
    kept = []
    for node in reversed(nodes):
        if wanted.intersection(node.output):
            wanted.update(node.input)
            kept.append(node)
    return kept[::-1]


def _terms(graph: GraphProto, node: NodeProto) -> list[Term]:
    """What `node` sums up, its bias apart; nothing where it is no product of a Concat with an initializer."""
    attributes = {one.name: helper.get_attribute_value(one) for one in node.attribute}
    if node.op_type != "Gemm" or any(attributes.get(name, value) != value for name, value in _PLAIN.items()):
        return []
    joined = _joined(graph, node.input[0])
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


def _joined(graph: GraphProto, name: str) -> list[str]:
    """The values that `name` is put together of, by one Concat or several nested ones; else itself."""
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


def _product(graph: GraphProto, terms: Sequence[Term], added: Sequence[str], output: str) -> list[NodeProto]:
    """Nodes that sum up `terms` and what is `added`; the weights and the shape of `output` are told to `graph`."""
    weight = np.concatenate([matrix for _, matrix in terms])
    names = joined, weights = f"{output}/joined", f"{output}/weights"
    graph.initializer.append(numpy_helper.from_array(weight, weights))
    graph.value_info.append(helper.make_tensor_value_info(output, TensorProto.FLOAT, (1, weight.shape[1])))
    return [
        helper.make_node("Concat", [name for name, _ in terms], [joined], axis=1),
        helper.make_node("Gemm", [*names, *added], [output]),
    ]
