"""Learned velocity estimator at run time: a recurrent network, one step per sample.

`features` builds the input, `tracker` feeds the samples, and `quadvel_training.estimator` trains
it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.network_file import NetworkFileError
from quadvel_description.network_input import InputLayout
from quadvel_description.recurrent_network import RecurrentNetwork
from quadvel_description.robot import Robot
from quadvel_description.robot_name import shipped_file
from quadvel_description.state import RobotState

from . import features

_DIAGONAL = np.arange(3), np.arange(3)
_MODELS = Path(__file__).parent / "models"
SHIPPED_MODEL = _MODELS / "estimator.onnx"


def shipped_estimator(robot: Robot) -> Path:
    """Find the shipped estimator of a robot.

    Args:
        robot: The robot.

    Returns:
        Its ONNX file.

    Raises:
        FileNotFoundError: None is shipped for this robot.
    """
    remedy = "choose the Kalman filter with --estimator kalman"
    return shipped_file(_MODELS, robot.name, SHIPPED_MODEL.name, "velocity estimator", remedy)


class LearnedEstimator:
    """Runs a velocity network on samples at the rate of its training, `features.RATE_HZ`."""

    def __init__(self, robot: Robot, path: str | Path | None = None) -> None:
        """Load a network and check its metadata.

        Args:
            robot: The robot.
            path: The ONNX file; None for the shipped one.

        Raises:
            NetworkFileError: The file is missing or is not a velocity estimator for this robot and
                rate.
        """
        path = shipped_estimator(robot) if path is None else path
        self._robot = robot
        self._network = RecurrentNetwork(path, robot.name, features.OUTPUTS, features.METADATA_FIELDS)
        metadata = self._network.metadata
        self._expect("metadata field kind", metadata["kind"], features.KIND)
        self._expect("metadata field rate_hz", metadata["rate_hz"], features.RATE_HZ)
        self._expect("metadata field nominal_q", metadata["nominal_q"], robot.nominal_q.tolist())
        try:
            self._layout = InputLayout.from_metadata(metadata["inputs"], features.KNOWN_INPUTS)
        except ValueError as error:
            raise NetworkFileError(f"{path}: metadata field inputs {error}") from None
        self._expect("length of input obs", self._network.input_size, self._layout.size)
        self._scale = metadata["output_scale"]
        if not isinstance(self._scale, int | float) or not 0.0 < self._scale < float("inf"):
            raise self._network.mismatch_error(
                "metadata field output_scale", self._scale, "a positive number"
            )

    def reset(self) -> None:
        """Reset the recurrent state of the network."""
        self._network.reset()

    def update(self, state: RobotState, previous_action: ArrayLike) -> tuple[Array, Array]:
        """Process one sample.

            v = s * output,   covariance = diag(s^2 exp(log_variance)),   s = output_scale

        Args:
            state: The measured state.
            previous_action: As in `features.build`, (12,), rad.

        Returns:
            Velocity of the trunk in the body frame, (3,), m/s, and its covariance, (3, 3), (m/s)^2.

        Raises:
            FloatingPointError: The result is not finite; call `reset` before the next sample.
        """
        velocity, log_variance = self._network.step(
            features.build(self._robot, state, previous_action, self._layout)
        )
        covariance = np.zeros((3, 3))
        covariance[_DIAGONAL] = self._scale**2 * np.exp(log_variance, dtype=np.float64)
        return np.multiply(velocity, self._scale, dtype=np.float64), covariance

    def _expect(self, what: str, found: object, expected: object) -> None:
        if found != expected:
            raise self._network.mismatch_error(what, found, expected)
