"""Reader of rl_sar's pair of YAML files: `base.yaml` of a robot and `config.yaml` of a policy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadvel_description.bounded_yaml import read_yaml
from quadvel_description.quadruped import JOINT_NAMES

from ..observation import JOINTS, Bounds
from .metadata import ImportedMetadata
from .observation import TERM_SIZES, ImportedTerm
from .section import FormatError, Section, to_our_order

TERMS = {
    "lin_vel": ("linear_velocity", "lin_vel_scale"),
    "ang_vel": ("angular_velocity", "ang_vel_scale"),
    "gravity_vec": ("gravity", ""),
    "commands": ("command", "commands_scale"),
    "dof_pos": ("q", "dof_pos_scale"),
    "dof_vel": ("dq", "dof_vel_scale"),
    "actions": ("previous_action", ""),
}
"""Our quantity and the field of its scale ("": 1) by name of the term."""
POSTURE_FIELD = "default_dof_pos"
"""The default posture, rad, in the order of the network."""
USED_FIELDS = (
    "dt", "decimation", "num_of_dofs", "wheel_indices", "joint_names", "joint_mapping", "default_dof_pos",
    "rl_kp", "rl_kd", "action_scale", "clip_obs", "clip_actions_lower", "clip_actions_upper",
    "num_observations", "observations", "observations_history", "observations_history_priority",
    "lin_vel_scale", "ang_vel_scale", "dof_pos_scale", "dof_vel_scale", "commands_scale",
)  # fmt: skip
UNUSED_FIELDS = ("model_name", "fixed_kp", "fixed_kd", "torque_limits", "joint_controller_names")
"""Fields for standing up, limits of torque, and names in rl_sar; ours are in robot.yaml."""


def is_config(fields: object) -> bool:
    """Recognise the format.

    Args:
        fields: Content of a YAML file.

    Returns:
        Whether it is a config.yaml: one key "robot/policy".
    """
    return isinstance(fields, Mapping) and len(fields) == 1 and "/" in str(next(iter(fields)))


def read(path: Path, fields: Any, robot: str, output: str, limits: dict[str, Bounds]) -> ImportedMetadata:
    """Read a config.yaml and the base.yaml of its robot, in the folder above or the same folder.

    Args:
        path: The config.yaml.
        fields: Its content.
        robot: Name of the robot.
        output: Name of the network's output with the action.
        limits: Commands of the training; the format does not have them.

    Returns:
        The metadata.

    Raises:
        FormatError: A field is missing or does not fit.
    """
    file = _merged(path, fields, robot)
    file.allow_only([*USED_FIELDS, *UNUSED_FIELDS])
    if file.fields.get("num_of_dofs") != JOINTS:
        file.refuse("num_of_dofs", str(JOINTS))
    if file.fields.get("wheel_indices", []) != []:
        file.refuse("wheel_indices", "none: wheels are not supported")
    if "joint_names" in file.fields and file.texts("joint_names") != JOINT_NAMES:
        file.refuse("joint_names", ", ".join(JOINT_NAMES))
    joint_map = file.joint_map("joint_mapping")
    period = file.number("dt") * file.number("decimation")
    file.check_period("decimation", period, "dt * decimation to be ")
    lower, upper = (file.numbers(f"clip_actions_{end}", JOINTS) for end in ("lower", "upper"))
    nominal, scale = file.numbers(POSTURE_FIELD, JOINTS), file.numbers("action_scale", JOINTS)
    targets = np.sort(np.array(nominal) + np.array([lower, upper]) * scale, axis=0)
    ages = _ages(file)
    terms = tuple(_term(file, name, nominal, (lower, upper), ages) for name in file.texts("observations"))
    count = sum(TERM_SIZES[term.name] for term in terms)
    if file.number("num_observations") != count:
        file.refuse("num_observations", f"{count}, the length of the observations")
    return ImportedMetadata(
        robot=robot,
        source=f"rl_sar {path.name}",
        joint_map=joint_map,
        terms=terms,
        history_by=_history_by(file),
        nominal_q=to_our_order(nominal, joint_map),
        action_offset=to_our_order(nominal, joint_map),
        action_scale=to_our_order(scale, joint_map),
        target_low=to_our_order(tuple(targets[0].tolist()), joint_map),
        target_high=to_our_order(tuple(targets[1].tolist()), joint_map),
        kp=to_our_order(file.gains("rl_kp", "kp"), joint_map),
        kd=to_our_order(file.gains("rl_kd", "kd"), joint_map),
        rate_hz=1.0 / period,
        command_limits=limits,
        output=output,
    )


def _merged(path: Path, fields: Any, robot: str) -> Section:
    """Return the fields of both files; those of config.yaml replace those of base.yaml."""
    candidates = [path.parent.parent / "base.yaml", path.parent / "base.yaml"]
    base = next((one for one in candidates if one.is_file()), None)
    if base is None:
        raise FormatError(f"{path}: found no base.yaml of its robot, expected {candidates[0]}")
    merged: dict[str, Any] = {}
    files: dict[str, Path] = {}
    for file, content in ((base, read_yaml(base, "rl_sar's base.yaml")), (path, fields)):
        whole = Section(file, content)
        key = next(iter(whole.fields), "")
        if str(key).partition("/")[0] != robot:
            raise FormatError(f"{file}: robot: found {key!r}, expected {robot!r}")
        inner = whole.section(key).fields
        merged |= inner
        files |= dict.fromkeys(inner, file)
    return Section(path, merged, files=files)


def _term(
    file: Section,
    name: str,
    nominal: tuple[float, ...],
    action_bounds: tuple[tuple[float, ...], tuple[float, ...]],
    ages: tuple[int, ...],
) -> ImportedTerm:
    """Read a term; rl_sar clips the whole observation to clip_obs, and the action before it is observed."""
    if name not in TERMS:
        file.refuse("observations", f"only terms that can be supplied ({', '.join(TERMS)}), not {name!r}")
    ours, scale = TERMS[name]
    size, clip = TERM_SIZES[ours], file.number("clip_obs")
    if clip <= 0.0:
        file.refuse("clip_obs", "a bound above 0")
    low, high = np.full(size, -clip), np.full(size, clip)
    if ours == "previous_action":
        low, high = np.maximum(low, action_bounds[0]), np.minimum(high, action_bounds[1])
    return ImportedTerm(
        name=ours,
        offset=nominal if ours == "q" else (0.0,) * size,
        scale=file.numbers(scale, size) if scale else (1.0,) * size,
        low=tuple(low.tolist()),
        high=tuple(high.tolist()),
        ages=ages,
    )


def _ages(file: Section) -> tuple[int, ...]:
    """Read the steps of the history; none stands for the newest alone."""
    name = "observations_history"
    ages = file.fields.get(name) or [0]
    if not isinstance(ages, list) or not all(type(age) is int and age >= 0 for age in ages):
        file.refuse(name, "a list of steps, 0 the newest")
    return tuple(ages)


def _history_by(file: Section) -> str:
    """Read the order of the history."""
    name = "observations_history_priority"
    orders = {"time": "step", "term": "term"}
    if (found := file.fields.get(name, "time")) not in orders:
        file.refuse(name, f"one of {', '.join(orders)}")
    return orders[found]
