"""Narrower command limits for an existing policy file, where its drives would be overloaded."""

from __future__ import annotations

from pathlib import Path

import attrs
import onnx

from quadvel_description.network_file import read_network
from quadvel_description.recurrent_network import METADATA_KEY
from quadvel_eval.output import replacing
from quadvel_policy.observation import COMMAND_AXES, CommandLimits
from quadvel_policy.policy_file import PolicyFile


def limit_commands(policy: Path, limits: CommandLimits) -> None:
    """Rewrite the limits in a policy file's metadata; the network and all other metadata stay as they are.

    Args:
        policy: the ONNX file, replaced as a whole or not at all.
        limits: the new lowest and highest vx, vy (m/s), wz (rad/s), and the limit of curves (m/s^2).

    Raises:
        ValueError: limits wider than those in the file, which the policy was not trained for.
        NetworkFileError: no policy file.
    """
    metadata = PolicyFile(policy).metadata
    bounds = dict(zip(COMMAND_AXES, zip(limits.low, limits.high, strict=True), strict=True))
    for axis, (low, high) in bounds.items():
        least, most = metadata.command_limits[axis]
        if not least <= low <= 0.0 <= high <= most:
            raise ValueError(
                f"{policy}: command_limits.{axis}: asked for {low:g} to {high:g}, expected a part of {least:g} to {most:g} with 0"
            )
    narrowed = attrs.evolve(metadata, command_limits=bounds, curve_limit=limits.curve)
    model = read_network(policy)
    onnx.helper.set_model_props(model, {METADATA_KEY: narrowed.to_json()})
    with replacing(policy) as draft:
        onnx.save(model, draft)
