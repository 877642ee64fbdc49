"""An ONNX network with an LSTM's memory and a description of itself: policy files and estimator files.

Loads the file, checks by name that it is what the caller expects, and runs it one step at a time on one
thread. What the inputs and outputs mean is the caller's matter.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from .robot import JOINT_NAMES

METADATA_KEY = "quadvel"
SCHEMA = 1
MEMORY_INPUTS = ("h_in", "c_in")
MEMORY_OUTPUTS = ("h_out", "c_out")


class NetworkFileError(ValueError):
    """A network file that is missing, unreadable or not what was asked for, in one sentence with its name."""


class RecurrentNetwork:
    """Inputs `obs` (1, n), `h_in`, `c_in`; outputs `outputs`, `h_out`, `c_out`; all float32.

    `outputs` gives the length m of each output (1, m) by its name, in order. `fields` are the metadata fields
    that the caller needs besides `schema`, `joint_names` and `state_shape`, the shape of both memories. Raises
    NetworkFileError.
    """

    def __init__(self, path: str | Path, outputs: Mapping[str, int], fields: Sequence[str] = ()) -> None:
        self.path = Path(path)
        self._session = self._open()
        self.metadata = self._read_metadata(("schema", "joint_names", "state_shape", *fields))
        self._require("metadata field schema", self.metadata["schema"], SCHEMA)
        self._require("metadata field joint_names", self.metadata["joint_names"], list(JOINT_NAMES))
        self._outputs = dict(outputs)
        self._check_signature()
        self._try_out()
        self._input = np.zeros((1, self.input_size), np.float32)
        self._results = [np.zeros((1, size), np.float32) for size in self._outputs.values()]
        # Two memories that take turns: what one step writes, the next one reads, and nothing is copied.
        self._memories = [
            [np.zeros(self.metadata["state_shape"], np.float32) for _ in "hc"] for _ in range(2)
        ]
        self._bindings = [self._bind(*self._memories), self._bind(*self._memories[::-1])]
        self.reset()

    @property
    def input_size(self) -> int:
        """The length of `obs`."""
        return int(self._session.get_inputs()[0].shape[-1])

    def reset(self) -> None:
        """Forget everything seen so far."""
        self._turn = 0
        for memory in self._memories[0]:
            memory[:] = 0.0

    def step(self, observation: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """One time step: `obs` (n,) to the outputs, each (m,).

        Raises FloatingPointError where an output is not finite; the memory then is of no use until `reset`.
        """
        self._input[0] = observation
        self._session.run_with_iobinding(self._bindings[self._turn])
        self._turn = 1 - self._turn
        for name, result in zip(self._outputs, self._results, strict=True):
            if not np.isfinite(result).all():
                raise FloatingPointError(f"{self.path}: the network's output {name} is not finite")
        return [result[0].copy() for result in self._results]

    def _bind(self, read: list[NDArray[np.float32]], write: list[NDArray[np.float32]]) -> Any:
        """Tie the network to our arrays, so that a run looks up, converts and allocates nothing."""
        binding = self._session.io_binding()
        for name, array in zip(("obs", *MEMORY_INPUTS), (self._input, *read), strict=True):
            binding.bind_input(name, "cpu", 0, array.dtype, array.shape, array.ctypes.data)
        for name, array in zip((*self._outputs, *MEMORY_OUTPUTS), (*self._results, *write), strict=True):
            binding.bind_output(name, "cpu", 0, array.dtype, array.shape, array.ctypes.data)
        return binding

    def refuse(self, what: str, found: object, expected: object) -> NetworkFileError:
        """The error for a file of which `what` is `found`, for the caller to raise."""
        return NetworkFileError(f"{self.path}: {what} is {found!r}, expected {expected!r}")

    def _try_out(self) -> None:
        """One run on zeros: shows the true shapes of the outputs, and is the slow first run of the session."""
        memory = self.metadata["state_shape"]
        zeros = {name: np.zeros(memory, np.float32) for name in MEMORY_INPUTS}
        results = self._session.run(None, {"obs": np.zeros((1, self.input_size), np.float32), **zeros})
        expected = {name: (1, size) for name, size in self._outputs.items()}
        expected |= dict.fromkeys(MEMORY_OUTPUTS, tuple(memory))
        for (name, shape), result in zip(expected.items(), results, strict=True):
            self._require(f"shape of output {name}", result.shape, shape)
            if not np.isfinite(result).all():
                raise NetworkFileError(f"{self.path}: output {name} is not finite for an input of zeros")

    def _require(self, what: str, found: object, expected: object) -> None:
        if found != expected:
            raise self.refuse(what, found, expected)

    def _open(self) -> onnxruntime.InferenceSession:
        if not self.path.is_file():
            raise NetworkFileError(f"{self.path}: no such file, expected an ONNX network")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        # At batch size one, weights are streamed as they lie; packed for larger products they are slower by a tenth.
        options.add_session_config_entry("session.disable_prepacking", "1")
        options.log_severity_level = 4  # what goes wrong is raised, not printed
        try:
            return onnxruntime.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's exceptions share no other base
            raise NetworkFileError(
                f"{self.path}: is not an ONNX network that onnxruntime can read"
            ) from error

    def _read_metadata(self, fields: Sequence[str]) -> dict[str, Any]:
        text = self._session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
        if text is None:
            raise NetworkFileError(
                f"{self.path}: has no metadata under the key {METADATA_KEY!r}, expected a JSON object"
            )
        try:
            metadata = json.loads(text)
        except ValueError:
            metadata = None
        if not isinstance(metadata, dict):
            raise NetworkFileError(
                f"{self.path}: metadata {METADATA_KEY!r} is {text[:40]!r}, expected a JSON object"
            )
        missing = [field for field in fields if field not in metadata]
        if missing:
            raise NetworkFileError(f"{self.path}: metadata {METADATA_KEY!r} lacks {', '.join(missing)}")
        return metadata

    def _check_signature(self) -> None:
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        self._require("list of inputs", [i.name for i in inputs], ["obs", *MEMORY_INPUTS])
        self._require("list of outputs", [o.name for o in outputs], [*self._outputs, *MEMORY_OUTPUTS])
        self._require("types of the inputs", {i.type for i in inputs}, {"tensor(float)"})
        for memory in inputs[1:]:
            self._require(f"shape of input {memory.name}", memory.shape, self.metadata["state_shape"])
        shape = inputs[0].shape
        if len(shape) != 2 or shape[0] != 1 or not isinstance(shape[1], int):
            raise self.refuse("shape of input obs", shape, [1, "n"])
