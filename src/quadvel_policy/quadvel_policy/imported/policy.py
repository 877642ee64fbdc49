"""Runs the network of an imported policy; its metadata say what the numbers mean.

`importer` reads the formats, `metadata` describes the numbers, and `observation` builds the input.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from quadvel_description.network_file import NetworkFileError, metadata_texts, read_network
from quadvel_description.onnx_format import Message
from quadvel_description.recurrent_network import open_session
from quadvel_description.robot import Robot

from .metadata import IMPORTED_KEY, ImportedMetadata


class ImportedPolicy:
    """A network without memory that another project trained, in a file of `quadvel policy import`.

    Attributes:
        metadata: Terms, joint map, gains, rate and limits.
    """

    def __init__(self, robot: Robot, path: str | Path, model: Message | None = None) -> None:
        """Load and check a file.

        Args:
            robot: The robot that the policy has to belong to.
            path: The ONNX file.
            model: Its network; None to read it.

        Raises:
            NetworkFileError: The file is missing, or is not an imported policy for this robot.
        """
        path = Path(path)
        model = read_network(path) if model is None else model
        text = metadata_texts(model).get(IMPORTED_KEY)
        if text is None:
            raise NetworkFileError(f"{path}: has no metadata under the key {IMPORTED_KEY!r}, expected them")
        try:
            self.metadata = ImportedMetadata.from_json(text, path)
        except ValueError as error:
            raise NetworkFileError(str(error)) from None
        if self.metadata.robot != robot.name:
            raise NetworkFileError(
                f"{path}: metadata field robot is {self.metadata.robot!r}, expected {robot.name!r}, the robot "
                "that is started (--robot)"
            )
        self._path, self._output = path, self.metadata.output
        self._session = open_session(path, model)
        self._input = _only_input(path, self._session, self.metadata.size)
        self._check_output()

    def reset(self) -> None:
        """Do nothing: the network has no memory."""

    def step(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Run one step.

        Args:
            observation: The network input, (n,).

        Returns:
            The raw action in the network's order of joints, (12,).

        Raises:
            FloatingPointError: The output is not finite.
        """
        (result,) = self._session.run([self._output], {self._input: observation[None]})
        action: NDArray[np.float32] = result[0]
        if not np.isfinite(action).all():
            raise FloatingPointError(f"{self._path}: the network's output {self._output} is not finite")
        return action

    def _check_output(self) -> None:
        """Run on zeros once: checks the shape of the action and takes the slow first run."""
        size, expected = self.metadata.size, (1, len(self.metadata.joint_map))
        try:
            (result,) = self._session.run([self._output], {self._input: np.zeros((1, size), np.float32)})
        except Exception as error:  # onnxruntime's exceptions share no other base
            raise NetworkFileError(
                f"{self._path}: does not run on an input of zeros: {str(error)[:200]}"
            ) from error
        if result.shape != expected:
            raise NetworkFileError(
                f"{self._path}: shape of output {self._output} is {result.shape}, expected {expected}"
            )


def _only_input(path: Path, session: onnxruntime.InferenceSession, size: int) -> str:
    """Return the name of the network's input; anything but one input of the right length is refused."""
    inputs = session.get_inputs()
    if len(inputs) != 1 or inputs[0].type != "tensor(float)":
        found = [(one.name, one.shape, one.type) for one in inputs]
        raise NetworkFileError(f"{path}: inputs are {found}, expected one of float32: no memory is supported")
    shape = inputs[0].shape
    if len(shape) != 2 or (shape[0] not in (1, None) and not isinstance(shape[0], str)) or shape[1] != size:
        raise NetworkFileError(
            f"{path}: shape of input {inputs[0].name} is {shape}, expected [1, {size}] for the observation terms"
        )
    return str(inputs[0].name)
