"""Safe reader of ONNX files: accepts data-flow graphs only.

Everything that is not on the lists below is refused before it runs: references to other files,
custom operators, control flow, and sizes that are too large for a control step.
`recurrent_network` interprets the network.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from .onnx_format import MAX_VALUES, FormatError, Message, TooManyValuesError, parse

MAX_FILE_BYTES = 16_000_000
"""Ten times the shipped policy; a core reads this many bytes in a third of a 5 ms step."""
MAX_PARTS = 50_000
"""Largest number of nested messages: nodes, attributes, tensors; the shipped policy has 100."""
MAX_TENSOR_NUMBERS = MAX_FILE_BYTES // 4
SUPPORTED_OPSETS = range(11, 22)
"""From the oldest one in public policies to the last one that onnxruntime 1.20 runs."""
UNUSED_DOMAINS = ("ai.onnx.ml",)
"""Operator sets that exporters name without use; a node of one is refused."""

# Operators of ONNX's own domain. None of them runs a subgraph, draws random numbers, or creates an
# output whose size is the value of an input, but Expand, which is allowed only to the shape of
# another value, and Conv, which is allowed only without padding.
ALLOWED_OPERATORS = """
    Abs Acos Add And Asin Atan Cast Clip Concat Constant Conv Cos Div Elu Equal Erf Exp Expand Flatten Floor GRU
    Gather Gemm Greater GreaterOrEqual HardSigmoid Identity LSTM LayerNormalization LeakyRelu Less LessOrEqual Log
    MatMul Max Min Mod Mul Neg NonZero Not Or Pow RNN ReduceL2 ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum
    Relu Reshape Round Selu Shape Sigmoid Sign Sin Slice Softmax Softplus Split Sqrt Squeeze Sub Tan Tanh Transpose
    Unsqueeze Where
    """
# Message fields of the format; no external data, subgraphs, functions, sparse tensors, training.
ALLOWED_PARTS = """
    ModelProto.graph ModelProto.metadata_props ModelProto.opset_import
    GraphProto.initializer GraphProto.input GraphProto.metadata_props GraphProto.node GraphProto.output
    GraphProto.value_info NodeProto.attribute NodeProto.metadata_props AttributeProto.t
    ValueInfoProto.type ValueInfoProto.metadata_props TypeProto.tensor_type TypeProto.Tensor.shape TensorShapeProto.dim
    """
ALLOWED_TENSOR_TYPES = {1: "FLOAT", 6: "INT32", 7: "INT64", 9: "BOOL"}
"""Numbers of TensorProto.data_type."""


class NetworkFileError(ValueError):
    """A network file is missing, unreadable or of a wrong kind; the message names it."""


def read_network(path: Path) -> Message:
    """Read a network from a file.

    Unknown fields of the format are discarded, so that a later reader sees only what was checked.

    Args:
        path: Path of an ONNX file.

    Returns:
        The network, a "ModelProto".

    Raises:
        NetworkFileError: The file is missing or unreadable, or holds something that is not allowed.
    """
    if not path.is_file():
        raise NetworkFileError(f"{path}: no such file, expected an ONNX network")
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise NetworkFileError(f"{path}: can't be read: {error.strerror}") from None
    if len(content) > MAX_FILE_BYTES:
        found, expected = (f"{length / 1e6:.1f} MB" for length in (size, MAX_FILE_BYTES))
        raise NetworkFileError(f"{path}: has {found}, expected at most {expected} to be run at 200 Hz")
    try:
        model = parse(content)
    except TooManyValuesError:
        raise NetworkFileError(f"{path}: has more than {MAX_VALUES} values, expected fewer") from None
    except FormatError:
        model = None
    if model is None or not model.one("ir_version"):  # every network has it; other parsable files do not
        start = content[:8]
        raise NetworkFileError(
            f"{path}: is not an ONNX network, or not a whole one: {size} bytes that begin with {start!r}"
        )
    for problem in _find_problems(model):
        raise NetworkFileError(f"{path}: {problem}")
    return model


def metadata_texts(model: Message) -> dict[str, str]:
    """Return the texts that a network carries as metadata.

    Args:
        model: The network, a "ModelProto".

    Returns:
        Text by key.
    """
    return {entry.one("key"): entry.one("value", "") for entry in model.all("metadata_props")}


def _find_problems(model: Message) -> Iterator[str]:
    """Yield a sentence for everything that is not allowed."""
    known = ALLOWED_PARTS.split()
    parts = list(islice(model.parts(), MAX_PARTS + 1))
    shapes = {
        name
        for _, part in parts
        if isinstance(part, Message) and part.kind == "NodeProto" and part.one("op_type") == "Shape"
        for name in part.all("output")
    }
    if len(parts) > MAX_PARTS:
        yield f"has more than {MAX_PARTS} parts, expected fewer: so many operators are no step of 5 ms"
    opsets = [
        (domain, one.one("version", 0))
        for one in model.all("opset_import")
        if (domain := one.one("domain", "")) not in UNUSED_DOMAINS
    ]
    if len(opsets) != 1 or opsets[0][0] != "" or opsets[0][1] not in SUPPORTED_OPSETS:
        found = ", ".join(f"{domain or 'ai.onnx'} {version}" for domain, version in opsets) or "none"
        yield f"operators come from the sets {found}, expected ai.onnx {SUPPORTED_OPSETS[0]} to {SUPPORTED_OPSETS[-1]} alone"
    for place, part in parts:
        if place not in known or isinstance(part, bytes):
            yield f"has a part {place}, expected none: a network here is one graph of operators and plain tensors"
        elif not part.is_readable():
            yield f"has a part {place} with a text that is not UTF-8, expected names that can be read"
        elif part.kind == "NodeProto":
            yield from _find_node_problems(part, shapes)
        elif part.kind == "TensorProto":
            yield from _find_tensor_problems(part)


def _find_node_problems(node: Message, shapes: set[str]) -> Iterator[str]:
    """Yield a sentence for an operator that is not allowed; `shapes` are the outputs of all Shapes."""
    domain, operator, name = node.one("domain", ""), node.one("op_type", ""), node.one("name", "")
    padding = [one.all("ints") for one in node.all("attribute") if one.one("name", "") == "pads"]
    if domain or operator not in ALLOWED_OPERATORS.split():
        full = f"{domain}.{operator}" if domain else operator
        yield f"operator {full!r} of node {name!r} is not one of those that are run: " + " ".join(
            ALLOWED_OPERATORS.split()
        )
    elif operator == "Expand" and not shapes.issuperset(node.all("input")[1:]):
        yield (
            f"operator 'Expand' of node {name!r} expands to {node.all('input')[1:]}, "
            "expected the output of a Shape: no size is a number in the file"
        )
    elif operator == "Conv" and any(map(any, padding)):
        yield f"operator 'Conv' of node {name!r} has the attribute pads {padding[0]}, expected zeros"


def _find_tensor_problems(tensor: Message) -> Iterator[str]:
    """Yield a sentence for every property of a tensor that is not allowed."""
    name, kind, dims = tensor.one("name", ""), tensor.one("data_type", 0), tensor.all("dims")
    if tensor.one("data_location", 0):
        yield f"tensor {name!r} lies in another file, expected all data in this one (torch.onnx.export: external_data=False)"
    if kind not in ALLOWED_TENSOR_TYPES:
        expected = ", ".join(sorted(ALLOWED_TENSOR_TYPES.values()))
        yield f"tensor {name!r} is of type {kind}, expected {expected}"
    if min(dims, default=0) < 0 or math.prod(dims) > MAX_TENSOR_NUMBERS:
        yield f"tensor {name!r} has the shape {dims}, expected at most {MAX_TENSOR_NUMBERS} numbers"
