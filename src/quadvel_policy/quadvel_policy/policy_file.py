"""Policy file: one ONNX network with metadata that contain everything needed to run it.

`observation` defines input and output; the supervisor decides when the policy runs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from quadvel_description.network_file import NetworkFileError, metadata_texts, read_network
from quadvel_description.recurrent_network import RecurrentNetwork
from quadvel_description.robot import Robot
from quadvel_description.robot_name import shipped_file

from .imported.metadata import IMPORTED_KEY
from .imported.policy import ImportedPolicy
from .observation import JOINTS, RATE_HZ, REQUIRED_FIELDS, MetadataError, PolicyMetadata

_POLICIES = Path(__file__).parent / "policies"
SHIPPED_POLICY = _POLICIES / "crl_eam.onnx"
NO_POLICY = "none"
"""Choice of a robot that only stands up, stands and lies down."""


def shipped_policy(robot: Robot) -> Path:
    """Find the shipped policy of a robot.

    Args:
        robot: The robot.

    Returns:
        Its ONNX file.

    Raises:
        FileNotFoundError: None is shipped for this robot.
    """
    remedy = (
        "quadvel up and eval take one of your own with --policy FILE; "
        "`quadvel up --robot ROBOT --policy none --estimator kalman` only stands"
    )
    return shipped_file(_POLICIES, robot.name, SHIPPED_POLICY.name, "policy", remedy)


def load_policy(robot: Robot, path: str | Path | None = None) -> PolicyFile | ImportedPolicy:
    """Load a policy that runs on a robot: one of our own, or an imported one.

    Args:
        robot: The robot that the policy has to belong to.
        path: The ONNX file; None for the shipped one.

    Returns:
        The policy.

    Raises:
        NetworkFileError: The file is missing or is not a policy for this robot; one sentence with
            the name of the file.
    """
    path = shipped_policy(robot) if path is None else Path(path)
    model = read_network(path)
    if IMPORTED_KEY in metadata_texts(model):
        return ImportedPolicy(robot, path, model)
    return PolicyFile(robot, path)


def chosen_policy(robot: Robot, choice: str) -> PolicyFile | ImportedPolicy | None:
    """Load the policy that a user chose.

    Args:
        robot: The robot that the policy has to belong to.
        choice: The ONNX file, "" for the shipped one, or NO_POLICY.

    Returns:
        The policy; None for NO_POLICY.

    Raises:
        NetworkFileError: As `load_policy`.
    """
    return None if choice == NO_POLICY else load_policy(robot, choice or None)


class PolicyFile:
    """A recurrent policy: inputs `obs, h_in, c_in`, outputs `actions, h_out, c_out`, and metadata.

    Attributes:
        metadata: The validated metadata.
    """

    def __init__(self, robot: Robot, path: str | Path | None = None) -> None:
        """Load and validate a policy file.

        Args:
            robot: The robot that the policy has to belong to.
            path: The ONNX file; None for the shipped one.

        Raises:
            NetworkFileError: The file is missing or is not a policy for this robot and rate; one
                sentence with the name of the file.
        """
        path = shipped_policy(robot) if path is None else Path(path)
        try:
            network = RecurrentNetwork(path, robot.name, {"actions": JOINTS}, REQUIRED_FIELDS)
        except NetworkFileError:
            if IMPORTED_KEY not in metadata_texts(read_network(path)):
                raise
            raise NetworkFileError(
                f"{path}: found a policy of another project ({IMPORTED_KEY}), expected one of this project: "
                "imported policies run with up and eval"
            ) from None
        try:
            self.metadata = PolicyMetadata.from_fields(network.metadata)
        except MetadataError as error:
            raise NetworkFileError(f"{path}: {error}") from None
        if self.metadata.rate_hz != RATE_HZ:
            raise network.mismatch_error("metadata field rate_hz", self.metadata.rate_hz, RATE_HZ)
        if network.input_size != self.metadata.observation.size:
            raise network.mismatch_error(
                "length of input obs", network.input_size, self.metadata.observation.size
            )
        self._network = network

    def reset(self) -> None:
        """Reset the recurrent state."""
        self._network.reset()

    def step(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Run one step.

        Args:
            observation: The network input, (n,), as `build_observation` makes it.

        Returns:
            The raw action, (12,).

        Raises:
            FloatingPointError: The output is not finite; call `reset` before the next step.
        """
        (action,) = self._network.step(observation)
        return action
