"""ONNX network with LSTM memory and metadata, run step by step: policies and estimators.

Inputs, outputs and metadata of the file must match what the caller expects. A step runs on one
thread.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from .network_file import NetworkFileError, read_network
from .onnx_format import Message, serialise
from .quadruped import JOINT_NAMES
from .robot_name import UNNAMED_ROBOT

METADATA_KEY = "quadvel"
SCHEMA = 1
MAX_INPUT_LENGTH = 10_000
"""Largest number of values of one input."""
MEMORY_INPUTS = ("h_in", "c_in")
MEMORY_OUTPUTS = ("h_out", "c_out")


def open_session(path: Path, model: Message) -> onnxruntime.InferenceSession:
    """Open a session of a network that runs on one thread.

    Args:
        path: File of the network, for the error message.
        model: The network.

    Returns:
        The session.

    Raises:
        NetworkFileError: onnxruntime cannot read the network.
    """
    try:
        return onnxruntime.InferenceSession(
            serialise(model), _session_options(), providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime's exceptions share no other base
        raise NetworkFileError(f"{path}: is not an ONNX network that onnxruntime can read") from error


def _session_options() -> onnxruntime.SessionOptions:
    """Return options of a session that runs on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    # At batch size one, weights in their stored order are 10 % faster than prepacked ones.
    options.add_session_config_entry("session.disable_prepacking", "1")
    options.log_severity_level = 4  # what goes wrong is raised, not printed
    return options


class _BoundRun:
    """Session bound to arrays by name: a run looks up, converts and allocates nothing."""

    def __init__(
        self, session: onnxruntime.InferenceSession, arrays: Mapping[str, NDArray[np.float32]]
    ) -> None:
        self._session, self._binding = session, session.io_binding()
        self._arrays = arrays  # the binding holds their addresses alone
        for tie, ends in (
            (self._binding.bind_input, session.get_inputs()),
            (self._binding.bind_output, session.get_outputs()),
        ):
            for array, name in ((arrays[end.name], end.name) for end in ends):
                tie(name, "cpu", 0, array.dtype, array.shape, array.ctypes.data)

    def __call__(self) -> None:
        self._session.run_with_iobinding(self._binding)


class RecurrentNetwork:
    """Recurrent network: inputs `obs` (1, n), `h_in`, `c_in`; outputs `h_out`, `c_out`; float32.

    Attributes:
        path: Path of the file.
        metadata: Metadata of the file, with the name of its robot.
    """

    def __init__(
        self, path: str | Path, robot: str, outputs: Mapping[str, int], fields: Sequence[str] = ()
    ) -> None:
        """Load and check a network file.

        Args:
            path: Path of the file.
            robot: Name of the robot that the network has to belong to.
            outputs: Length m of each further output (1, m), by name, in order.
            fields: Required metadata fields in addition to `schema`, `joint_names` and
                `state_shape` (the shape of both memories). The field `robot` may be missing: the
                network then belongs to UNNAMED_ROBOT.

        Raises:
            NetworkFileError: The file is unreadable, does not match or belongs to another robot.
        """
        self.path = Path(path)
        self._model = read_network(self.path)
        self._session = open_session(self.path, self._model)
        self.metadata = self._read_metadata(("schema", "joint_names", "state_shape", *fields))
        self._require("metadata field schema", self.metadata["schema"], SCHEMA)
        self._require("metadata field robot", self.metadata["robot"], robot)
        self._require("metadata field joint_names", self.metadata["joint_names"], list(JOINT_NAMES))
        self._outputs = dict(outputs)
        self._check_signature()
        self._run_on_zeros()
        self._input = np.zeros((1, self.input_size), np.float32)
        self._result = np.zeros((1, sum(self._outputs.values())), np.float32)  # all outputs, concatenated
        ends = np.cumsum([0, *self._outputs.values()]).tolist()
        self._output_slices = [slice(*place) for place in pairwise(ends)]
        # Two alternating memories: each step reads what the previous one wrote, without a copy.
        self._memories = [
            [np.zeros(self.metadata["state_shape"], np.float32) for _ in "hc"] for _ in range(2)
        ]
        self._runs = [self._bind(*self._memories), self._bind(*self._memories[::-1])]
        self.reset()

    @property
    def input_size(self) -> int:
        """Length of `obs`."""
        return int(self._session.get_inputs()[0].shape[-1])

    def reset(self) -> None:
        """Clear the memory."""
        self._memory_index = 0
        for memory in self._memories[0]:
            memory[:] = 0.0

    def step(self, observation: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """Compute one time step.

        Args:
            observation: Input `obs`, (n,).

        Returns:
            Outputs, (m,) each.

        Raises:
            FloatingPointError: An output is not finite; the memory is invalid until `reset`.
        """
        self._input[0] = observation
        self._runs[self._memory_index]()
        self._memory_index = 1 - self._memory_index
        result = self._result[0].copy()
        outputs = [result[place] for place in self._output_slices]
        if not all(map(math.isfinite, result.tolist())):  # faster than NumPy for so few numbers
            named = zip(self._outputs, outputs, strict=True)
            broken = next(name for name, output in named if not np.isfinite(output).all())
            raise FloatingPointError(f"{self.path}: the network's output {broken} is not finite")
        return outputs

    def _bind(self, read: Sequence[NDArray[np.float32]], write: Sequence[NDArray[np.float32]]) -> _BoundRun:
        """Return a run from one of the alternating memories to the other."""
        results = {
            name: self._result[:, place]
            for name, place in zip(self._outputs, self._output_slices, strict=True)
        }
        memories = dict(zip((*MEMORY_INPUTS, *MEMORY_OUTPUTS), (*read, *write), strict=True))
        return _BoundRun(self._session, {"obs": self._input, **memories, **results})

    def mismatch_error(self, what: str, found: object, expected: object) -> NetworkFileError:
        """Return the error for a property of the file, for the caller to raise.

        Args:
            what: The property.
            found: Its value.
            expected: Expected value.

        Returns:
            The error.
        """
        return NetworkFileError(f"{self.path}: {what} is {found!r}, expected {expected!r}")

    def _run_on_zeros(self) -> None:
        """Run on zeros once: checks the shapes of the outputs and takes the slow first run."""
        memory = self.metadata["state_shape"]
        zeros = {name: np.zeros(memory, np.float32) for name in MEMORY_INPUTS}
        inputs = {"obs": np.zeros((1, self.input_size), np.float32), **zeros}
        try:
            results = self._session.run(None, inputs)
        except Exception as error:  # onnxruntime's exceptions share no other base
            raise NetworkFileError(
                f"{self.path}: does not run on an input of zeros: {str(error)[:200]}"
            ) from error
        expected = {name: (1, size) for name, size in self._outputs.items()}
        expected |= dict.fromkeys(MEMORY_OUTPUTS, tuple(memory))
        for (name, shape), result in zip(expected.items(), results, strict=True):
            self._require(f"shape of output {name}", result.shape, shape)
            if not np.isfinite(result).all():
                raise NetworkFileError(f"{self.path}: output {name} is not finite for an input of zeros")

    def _require(self, what: str, found: object, expected: object) -> None:
        """Raise the mismatch error if values differ."""
        if found != expected:
            raise self.mismatch_error(what, found, expected)

    def _read_metadata(self, fields: Sequence[str]) -> dict[str, Any]:
        """Return the metadata and check that the fields exist."""
        text = self._session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
        if text is None:
            raise NetworkFileError(
                f"{self.path}: has no metadata under the key {METADATA_KEY!r}, expected a JSON object "
                "(`quadvel policy import` adds it to a policy of another project)"
            )
        try:
            metadata = json.loads(text)
        except (ValueError, RecursionError):
            metadata = None
        if not isinstance(metadata, dict):
            raise NetworkFileError(
                f"{self.path}: metadata {METADATA_KEY!r} is {text[:40]!r}, expected a JSON object"
            )
        missing = [field for field in fields if field not in metadata]
        if missing:
            raise NetworkFileError(f"{self.path}: metadata {METADATA_KEY!r} lacks {', '.join(missing)}")
        return {"robot": UNNAMED_ROBOT, **metadata}

    def _check_signature(self) -> None:
        """Check names, types and shapes of inputs and outputs."""
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        self._require("list of inputs", [i.name for i in inputs], ["obs", *MEMORY_INPUTS])
        self._require("list of outputs", [o.name for o in outputs], [*self._outputs, *MEMORY_OUTPUTS])
        self._require("types of the inputs", {i.type for i in inputs}, {"tensor(float)"})
        for memory in inputs[1:]:
            self._require(f"shape of input {memory.name}", memory.shape, self.metadata["state_shape"])
        for end in inputs:
            lengths = [length for length in end.shape if isinstance(length, int) and length > 0]
            if len(lengths) < len(end.shape) or math.prod(lengths) > MAX_INPUT_LENGTH:
                raise self.mismatch_error(
                    f"shape of input {end.name}", end.shape, f"at most {MAX_INPUT_LENGTH} numbers"
                )
        shape = inputs[0].shape
        if len(shape) != 2 or shape[0] != 1:
            raise self.mismatch_error("shape of input obs", shape, [1, "n"])
