"""Reads an ONNX file as what it has to be here: data, that computes outputs from inputs and does nothing else.

What is not on the lists below is refused before anything runs it: files of others it would have read, operators from
elsewhere, control flow, sizes that no step has time for. What the network means is `recurrent_network`'s matter.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from google.protobuf.message import DecodeError, Message
from onnx import ModelProto, TensorProto

LARGEST = 16_000_000  # bytes, ten times the shipped policy; a core reads so many in a third of a 5 ms step
MOST_PARTS = 50_000  # nodes, attributes, tensors and what else is told apart; the shipped policy has 100
LARGEST_TENSOR = LARGEST // 4  # numbers
OPSETS = range(13, 22)  # from the one that has axes as inputs to the last that onnxruntime 1.20 runs

# Of ONNX's own domain. None runs a subgraph, draws random numbers or makes an output as large as a number tells it.
OPERATORS = """
    Abs Acos Add And Asin Atan Cast Clip Concat Constant Cos Div Elu Equal Erf Exp Flatten Floor GRU Gather Gemm Greater
    GreaterOrEqual HardSigmoid Identity LSTM LayerNormalization LeakyRelu Less LessOrEqual Log MatMul Max Min Mod Mul Neg
    Not Or Pow RNN ReduceL2 ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum Relu Reshape Round Selu Shape Sigmoid
    Sign Sin Slice Softmax Softplus Split Sqrt Squeeze Sub Tan Tanh Transpose Unsqueeze Where
    """
# The fields of the format that hold others, but those for data elsewhere, subgraphs, functions, sparse tensors, training.
PARTS = """
    ModelProto.graph ModelProto.metadata_props ModelProto.opset_import
    GraphProto.initializer GraphProto.input GraphProto.metadata_props GraphProto.node GraphProto.output
    GraphProto.value_info NodeProto.attribute NodeProto.metadata_props AttributeProto.t
    ValueInfoProto.type ValueInfoProto.metadata_props TypeProto.tensor_type TypeProto.Tensor.shape TensorShapeProto.dim
    """
NUMBERS = TensorProto.FLOAT, TensorProto.INT32, TensorProto.INT64, TensorProto.BOOL


class NetworkFileError(ValueError):
    """A network file that is missing, unreadable or not what was asked for, in one sentence with its name."""


def read_network(path: Path) -> ModelProto:
    """The network in a file. Raises NetworkFileError for whatever is not on this module's lists.

    What this version of the format does not know is not in it, so that who runs it sees what was looked at.
    """
    if not path.is_file():
        raise NetworkFileError(f"{path}: no such file, expected an ONNX network")
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            content = file.read(LARGEST + 1)
    except OSError as error:
        raise NetworkFileError(f"{path}: can't be read: {error.strerror}") from None
    if len(content) > LARGEST:
        found, expected = (f"{length / 1e6:.1f} MB" for length in (size, LARGEST))
        raise NetworkFileError(f"{path}: has {found}, expected at most {expected} to be run at 200 Hz")
    model = _parsed(content)
    if model is None:
        start = content[:8]
        raise NetworkFileError(
            f"{path}: is not an ONNX network, or not a whole one: {size} bytes that begin with {start!r}"
        )
    for problem in _problems(model):
        raise NetworkFileError(f"{path}: {problem}")
    return model


def _parsed(content: bytes) -> ModelProto | None:
    model = ModelProto()
    try:
        model.ParseFromString(content)
    except DecodeError:
        return None
    model.DiscardUnknownFields()
    return model if model.ir_version else None  # which every network has, and other files that parse have not


def _problems(model: ModelProto) -> Iterator[str]:
    """What is not as it has to be, in the order in which it is found."""
    operators, known = OPERATORS.split(), PARTS.split()
    parts = list(islice(_parts(model), MOST_PARTS + 1))
    if len(parts) > MOST_PARTS:
        yield f"has more than {MOST_PARTS} parts, expected fewer: so many operators are no step of 5 ms"
    opsets = [(one.domain, one.version) for one in model.opset_import]
    if len(opsets) != 1 or opsets[0][0] != "" or opsets[0][1] not in OPSETS:
        found = ", ".join(f"{domain or 'ai.onnx'} {version}" for domain, version in opsets) or "none"
        yield f"operators come from the sets {found}, expected ai.onnx {OPSETS[0]} to {OPSETS[-1]} alone"
    for node in model.graph.node:
        if node.domain or node.op_type not in operators:
            name = f"{node.domain}.{node.op_type}" if node.domain else node.op_type
            yield f"operator {name!r} of node {node.name!r} is not one of those that are run: {' '.join(operators)}"
    for place, part in parts:
        if place not in known:
            yield f"has a part {place}, expected none: a network here is one graph of operators and plain tensors"
        if not _readable(part):
            yield f"has a part {place} with a text that is not UTF-8, expected names that can be read"
        if isinstance(part, TensorProto):
            yield from _tensor_problems(part)


def _tensor_problems(tensor: TensorProto) -> Iterator[str]:
    if tensor.data_location != TensorProto.DEFAULT:
        yield f"tensor {tensor.name!r} lies in another file, expected all data in this one"
    if tensor.data_type not in NUMBERS:
        expected = ", ".join(sorted(map(TensorProto.DataType.Name, NUMBERS)))
        yield f"tensor {tensor.name!r} is of type {tensor.data_type}, expected {expected}"
    if min(tensor.dims, default=0) < 0 or math.prod(tensor.dims) > LARGEST_TENSOR:
        yield f"tensor {tensor.name!r} has the shape {list(tensor.dims)}, expected at most {LARGEST_TENSOR} numbers"


def _readable(part: Message) -> bool:
    """Whether all texts of a part, those of others in it apart, are UTF-8; one that is not comes as bytes."""
    texts = [value for field, value in part.ListFields() if field.type == field.TYPE_STRING]
    return not any(
        isinstance(one, bytes) for text in texts for one in ([text] if isinstance(text, bytes) else text)
    )


def _parts(whole: Message) -> Iterator[tuple[str, Message]]:
    """All that a message holds, however deep, each with the field's name in the format."""
    for field, value in whole.ListFields():
        if field.message_type is not None:
            for part in [value] if isinstance(value, Message) else value:
                yield field.full_name.removeprefix("onnx."), part
                yield from _parts(part)
