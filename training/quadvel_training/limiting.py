"""Narrower command limits for a policy file whose fastest commands would overload the drives.

It only writes limits that the caller chose. `quadvel paper --only sustained` measures the load of
the drives at each command, and `python -m quadvel_training limit` calls this module.
"""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np

from quadvel_description.network_file import read_network
from quadvel_description.onnx_format import message, serialise
from quadvel_description.recurrent_network import METADATA_KEY
from quadvel_description.robot import Robot
from quadvel_policy.observation import COMMAND_AXES, VelocityCommandLimits
from quadvel_policy.policy_file import PolicyFile
from quadvel_recordings.output import atomic_write


def limit_commands(robot: Robot, policy: Path, limits: VelocityCommandLimits) -> None:
    """Rewrite the command limits in a policy file's metadata; everything else stays.

    Args:
        robot: robot of the policy.
        policy: ONNX file, replaced atomically.
        limits: new lowest and highest vx, vy (m/s) and wz (rad/s) in the body frame, and the
            largest lateral acceleration in curves (m/s^2).

    Raises:
        ValueError: the limits are wider than those in the file, which the policy was trained for.
        NetworkFileError: the file is no policy file.
    """
    metadata = PolicyFile(robot, policy).metadata
    bounds = dict(zip(COMMAND_AXES, zip(limits.low, limits.high, strict=True), strict=True))
    for axis, (low, high) in bounds.items():
        least, most = metadata.command_limits[axis]
        if not least <= low <= 0.0 <= high <= most:
            raise ValueError(
                f"{policy}: command_limits.{axis}: found {low:g} to {high:g}, expected a range within "
                f"{least:g} to {most:g} that contains 0"
            )
    if metadata.curve_limit is not None and (limits.curve or np.inf) > metadata.curve_limit:
        raise ValueError(
            f"{policy}: curve_limit: found {limits.curve} m/s^2, expected {metadata.curve_limit:g} or less"
        )
    narrowed = attrs.evolve(metadata, command_limits=bounds, curve_limit=limits.curve)
    model = read_network(policy)
    text = message("StringStringEntryProto", key=METADATA_KEY, value=narrowed.to_json())
    model.fields["metadata_props"] = [text]
    with atomic_write(policy) as draft:
        draft.write_bytes(serialise(model))
