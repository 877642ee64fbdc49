"""An ONNX network with an LSTM's memory and a description of itself: policy files and estimator files.

Loads the file, checks by name that it is what the caller expects, and runs it one step at a time on one
thread; who is pressed for time has part of a step done before its observation comes. What the inputs and
outputs mean is the caller's matter.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnx import ModelProto

from . import ahead
from .network_file import NetworkFileError, read_network
from .robot import JOINT_NAMES

METADATA_KEY = "quadvel"
SCHEMA = 1
LONGEST = 10_000  # numbers, of one input
MEMORY_INPUTS = ("h_in", "c_in")
MEMORY_OUTPUTS = ("h_out", "c_out")


def _options() -> onnxruntime.SessionOptions:
    """Of sessions that run on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    # At batch size one, weights are streamed as they lie; packed for larger products they are slower by a tenth.
    options.add_session_config_entry("session.disable_prepacking", "1")
    options.log_severity_level = 4  # what goes wrong is raised, not printed
    return options


class _Run:
    """A session tied to our arrays, by their names, so that a run looks up, converts and allocates nothing."""

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
    """Inputs `obs` (1, n), `h_in`, `c_in`; outputs `outputs`, `h_out`, `c_out`; all float32.

    `outputs` gives the length m of each output (1, m) by its name, in order. `fields` are the metadata fields
    that the caller needs besides `schema`, `joint_names` and `state_shape`, the shape of both memories. Raises
    NetworkFileError.
    """

    def __init__(self, path: str | Path, outputs: Mapping[str, int], fields: Sequence[str] = ()) -> None:
        self.path = Path(path)
        self._model = read_network(self.path)
        self._session = self._open(self._model)
        self.metadata = self._read_metadata(("schema", "joint_names", "state_shape", *fields))
        self._require("metadata field schema", self.metadata["schema"], SCHEMA)
        self._require("metadata field joint_names", self.metadata["joint_names"], list(JOINT_NAMES))
        self._outputs = dict(outputs)
        self._check_signature()
        self._try_out()
        self._input = np.zeros((1, self.input_size), np.float32)
        self._result = np.zeros((1, sum(self._outputs.values())), np.float32)  # all outputs side by side
        ends = np.cumsum([0, *self._outputs.values()]).tolist()
        self._places = [slice(*place) for place in pairwise(ends)]
        # Two memories that take turns: what one step writes, the next one reads, and nothing is copied.
        self._memories = [
            [np.zeros(self.metadata["state_shape"], np.float32) for _ in "hc"] for _ in range(2)
        ]
        self._whole = self._runs(self._session)
        self.reset()

    @property
    def input_size(self) -> int:
        """The length of `obs`."""
        return int(self._session.get_inputs()[0].shape[-1])

    def reset(self) -> None:
        """Forget everything seen so far."""
        self._turn, self._next = 0, self._whole
        for memory in self._memories[0]:
            memory[:] = 0.0

    def prepare(self) -> None:
        """Do of the next step what needs no observation, if the network has such a part; `step` then takes less time.

        May be left out. The first call, which cuts the network in two, is slow.
        """
        if self._halves is not None:
            ahead, self._next = self._halves
            ahead[self._turn]()

    def step(self, observation: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """One time step: `obs` (n,) to the outputs, each (m,).

        Raises FloatingPointError where an output is not finite; the memory then is of no use until `reset`.
        """
        self._input[0] = observation
        self._next[self._turn]()
        self._turn, self._next = 1 - self._turn, self._whole
        result = self._result[0].copy()
        outputs = [result[place] for place in self._places]
        if not all(map(math.isfinite, result.tolist())):  # for so few numbers quicker than NumPy
            named = zip(self._outputs, outputs, strict=True)
            broken = next(name for name, output in named if not np.isfinite(output).all())
            raise FloatingPointError(f"{self.path}: the network's output {broken} is not finite")
        return outputs

    @cached_property
    def _halves(self) -> tuple[list[_Run], list[_Run]] | None:
        """What runs ahead of an observation and what runs on it, or None where the network has no such parts."""
        models = ahead.cut(self._model, "obs")
        if models is None:
            return None
        before, after = map(self._open, models)
        handed_over = {end.name: np.zeros(end.shape, np.float32) for end in before.get_outputs()}
        return self._runs(before, handed_over), self._runs(after, handed_over)

    def _runs(
        self,
        session: onnxruntime.InferenceSession,
        handed_over: Mapping[str, NDArray[np.float32]] = MappingProxyType({}),
    ) -> list[_Run]:
        """A run for each turn of the memories."""
        return [
            _Run(
                session,
                {
                    "obs": self._input,
                    **dict(zip((*MEMORY_INPUTS, *MEMORY_OUTPUTS), (*read, *write), strict=True)),
                    **{
                        name: self._result[:, place]
                        for name, place in zip(self._outputs, self._places, strict=True)
                    },
                    **handed_over,
                },
            )
            for read, write in (self._memories, self._memories[::-1])
        ]

    def refuse(self, what: str, found: object, expected: object) -> NetworkFileError:
        """The error for a file of which `what` is `found`, for the caller to raise."""
        return NetworkFileError(f"{self.path}: {what} is {found!r}, expected {expected!r}")

    def _try_out(self) -> None:
        """One run on zeros: shows the true shapes of the outputs, and is the slow first run of the session."""
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
        if found != expected:
            raise self.refuse(what, found, expected)

    def _open(self, model: ModelProto) -> onnxruntime.InferenceSession:
        """The network, or a part of it, ready to run."""
        try:
            return onnxruntime.InferenceSession(
                model.SerializeToString(), _options(), providers=["CPUExecutionProvider"]
            )
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
        except (ValueError, RecursionError):
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
        for end in inputs:
            lengths = [length for length in end.shape if isinstance(length, int) and length > 0]
            if len(lengths) < len(end.shape) or math.prod(lengths) > LONGEST:
                raise self.refuse(f"shape of input {end.name}", end.shape, f"at most {LONGEST} numbers")
        shape = inputs[0].shape
        if len(shape) != 2 or shape[0] != 1:
            raise self.refuse("shape of input obs", shape, [1, "n"])
