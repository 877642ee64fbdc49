"""The policy as a file: one ONNX network that carries all that is needed to run it.

What its input and output mean is `observation`'s matter; when it may run is the supervisor's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from quadvel_description.network_file import NetworkFileError
from quadvel_description.recurrent_network import RecurrentNetwork

from .observation import JOINTS, RATE_HZ, REQUIRED_FIELDS, MetadataError, PolicyMetadata

SHIPPED_POLICY = Path(__file__).parent / "policies" / "crl_eam.onnx"


class PolicyFile:
    """A policy with its memory: inputs `obs, h_in, c_in`, outputs `actions, h_out, c_out`, and metadata.

    metadata: PolicyMetadata, checked. Raises NetworkFileError, one sentence with the file's name, where the
    file is missing or is not a policy for this robot and rate.
    """

    def __init__(self, path: str | Path = SHIPPED_POLICY) -> None:
        network = RecurrentNetwork(path, {"actions": JOINTS}, REQUIRED_FIELDS)
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
        """Forget everything seen so far."""
        self._network.reset()

    def prepare(self) -> None:
        """Do of the next step what needs no observation, so that it takes less time; may be left out."""
        self._network.prepare()

    def step(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """One tick: the network's input, as `build_observation` makes it, to its raw output (12,).

        Raises FloatingPointError where the output is not finite; the memory then is of no use until `reset`.
        """
        (action,) = self._network.step(observation)
        return action
