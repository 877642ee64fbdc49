"""Reader of unitree_rl_lab's `deploy.yaml`, which it writes with each policy for a Unitree robot."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..observation import JOINTS, Bounds
from .metadata import UNBOUNDED, ImportedMetadata
from .observation import TERM_SIZES, ImportedTerm
from .section import Section, to_our_order

TERMS = {
    "base_lin_vel": "linear_velocity",
    "base_ang_vel": "angular_velocity",
    "projected_gravity": "gravity",
    "velocity_commands": "command",
    "joint_pos": "q",
    "joint_pos_rel": "q",
    "joint_vel": "dq",
    "joint_vel_rel": "dq",
    "last_action": "previous_action",
}
"""Our quantity by name of the term."""
ORDER_FIELDS = ("use_gym_history", "scale_first")
"""Fields among the terms: history by step instead of by term; scale before clip instead of after."""
POSTURE_FIELD = "default_joint_pos"
"""The default posture, rad, in the order of the network."""
AXES = {"vx": "lin_vel_x", "vy": "lin_vel_y", "wz": "ang_vel_z"}


def is_deploy_yaml(fields: object) -> bool:
    """Recognise the format.

    Args:
        fields: Content of a YAML file.

    Returns:
        Whether it is a deploy.yaml.
    """
    return isinstance(fields, Mapping) and "joint_ids_map" in fields


def read(path: Path, fields: Any, robot: str, output: str) -> ImportedMetadata:
    """Read a deploy.yaml.

    Motor indices, `stiffness` and `damping` have the order FR, FL, RR, RL, everything else that of
    the network.

    Args:
        path: The file, for errors.
        fields: Its content.
        robot: Name of the robot.
        output: Name of the network's output with the action.

    Returns:
        The metadata.

    Raises:
        FormatError: A field is missing or does not fit.
    """
    file = Section(path, fields)
    file.allow_only(
        ["joint_ids_map", "step_dt", "stiffness", "damping", "default_joint_pos", "commands", "actions",
         "observations"]
    )  # fmt: skip
    joint_map = file.joint_map("joint_ids_map")
    period = file.number("step_dt")
    file.check_period("step_dt", period)
    nominal = file.numbers(POSTURE_FIELD, JOINTS)
    actions = file.section("actions")
    actions.allow_only(["JointPositionAction"])
    action = actions.section("JointPositionAction")
    action.allow_only(["clip", "joint_names", "scale", "offset", "joint_ids", "preserve_order"])
    if action.fields.get("joint_ids") not in (None, list(range(JOINTS))):
        action.refuse("joint_ids", "null: all joints in the network's order")
    low, high = action.bounds("clip", JOINTS) or ((-UNBOUNDED,) * JOINTS, (UNBOUNDED,) * JOINTS)
    observations = file.section("observations")
    return ImportedMetadata(
        robot=robot,
        source=f"unitree_rl_lab {path.name}",
        joint_map=joint_map,
        terms=tuple(
            _term(observations, name, nominal) for name in observations.fields if name not in ORDER_FIELDS
        ),
        history_by="step" if observations.flag("use_gym_history") else "term",
        nominal_q=to_our_order(nominal, joint_map),
        action_offset=to_our_order(action.numbers("offset", JOINTS), joint_map),
        action_scale=to_our_order(action.numbers("scale", JOINTS), joint_map),
        target_low=to_our_order(low, joint_map),
        target_high=to_our_order(high, joint_map),
        kp=file.gains("stiffness", "kp"),
        kd=file.gains("damping", "kd"),
        rate_hz=1.0 / period,
        command_limits=_command_limits(file),
        output=output,
    )


def _term(observations: Section, name: str, nominal: tuple[float, ...]) -> ImportedTerm:
    """Read a term; clip before scale equals scale before clip with scaled bounds."""
    if name not in TERMS:
        observations.refuse(name, f"only terms that can be supplied: {', '.join(TERMS)}")
    term, ours = observations.section(name), TERMS[name]
    size = TERM_SIZES[ours]
    term.allow_only(["params", "clip", "scale", "history_length", "flatten_history_dim"])
    params = term.fields.get("params") or {}
    if not isinstance(params, Mapping) or "asset_cfg" in params:
        term.refuse("params", "none: all joints in the network's order")
    length = term.numbers("history_length", 1, default=1)[0]
    if not length.is_integer() or length < 0:
        term.refuse("history_length", "a whole number of steps")
    scale = term.numbers("scale", size, default=1.0)
    bounds = term.bounds("clip", size)
    if bounds is not None and not observations.flag("scale_first"):
        bounds = _scaled(bounds, scale)
    return ImportedTerm(
        name=ours,
        offset=nominal if name == "joint_pos_rel" else (0.0,) * size,
        scale=scale,
        low=bounds and bounds[0],
        high=bounds and bounds[1],
        ages=tuple(range(max(int(length), 1)))[::-1],
    )


def _scaled(
    bounds: tuple[tuple[float, ...], tuple[float, ...]], scale: tuple[float, ...]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return bounds of scaled values; a negative scale swaps them."""
    ends = np.sort(np.array(bounds) * scale, axis=0)
    return tuple(ends[0].tolist()), tuple(ends[1].tolist())


def _command_limits(file: Section) -> dict[str, Bounds]:
    """Read the ranges of the velocity command."""
    ranges = file.section("commands").section("base_velocity").section("ranges")
    limits = {}
    for axis, name in AXES.items():
        pair = ranges.bounds(name, 1)
        if pair is None or not pair[0][0] <= 0.0 <= pair[1][0]:
            ranges.refuse(name, "a pair (low, high) with zero between")
        limits[axis] = (pair[0][0], pair[1][0])
    return limits
