"""Reader of the metadata that mjlab writes into its ONNX files: lists as texts with commas."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from quadvel_description.quadruped import JOINT_NAMES

from ..observation import JOINTS, Bounds
from .metadata import UNBOUNDED, ImportedMetadata
from .observation import TERM_SIZES, ImportedTerm
from .section import Section, to_our_order

TERMS = {
    "base_lin_vel": "linear_velocity",
    "base_ang_vel": "angular_velocity",
    "projected_gravity": "gravity",
    "command": "command",
    "joint_pos": "q",
    "joint_vel": "dq",
    "actions": "previous_action",
}
"""Our quantity by name of the term."""
POSTURE_FIELD = "default_joint_pos"
"""The default posture, rad, in the order of the network."""
NUMBER_FIELDS = ("joint_stiffness", "joint_damping", "default_joint_pos", "action_scale")
NAME_FIELDS = ("joint_names", "command_names", "observation_names")
UNUSED_FIELDS = ("run_path",)


def is_mjlab(metadata: Mapping[str, str]) -> bool:
    """Recognise the format.

    Args:
        metadata: Metadata of an ONNX file.

    Returns:
        Whether mjlab wrote them.
    """
    return "observation_names" in metadata and "joint_names" in metadata


def read(
    path: Path,
    metadata: Mapping[str, str],
    robot: str,
    output: str,
    limits: dict[str, Bounds],
    rate_hz: float,
) -> ImportedMetadata:
    """Read mjlab's metadata. Its `joint_pos` is relative to the default posture; its terms have no scale.

    Args:
        path: The ONNX file, for errors.
        metadata: Its metadata.
        robot: Name of the robot.
        output: Name of the network's output with the action.
        limits: Commands of the training; the format does not have them.
        rate_hz: Rate of the policy, Hz; the format does not have it.

    Returns:
        The metadata.

    Raises:
        FormatError: A field is missing or does not fit.
    """
    file = Section(path, {name: _values(name, text) for name, text in metadata.items()}, "metadata")
    file.allow_only([*NUMBER_FIELDS, *NAME_FIELDS, *UNUSED_FIELDS])
    names = file.texts("joint_names")
    if sorted(names) != sorted(JOINT_NAMES):
        file.refuse("joint_names", f"each of {', '.join(JOINT_NAMES)} once")
    joint_map = tuple(JOINT_NAMES.index(name) for name in names)
    if len(file.texts("command_names")) != 1:
        file.refuse("command_names", "one command, a velocity")
    nominal = file.numbers(POSTURE_FIELD, JOINTS)
    return ImportedMetadata(
        robot=robot,
        source="mjlab metadata",
        joint_map=joint_map,
        terms=tuple(_term(file, name, nominal) for name in file.texts("observation_names")),
        nominal_q=to_our_order(nominal, joint_map),
        action_offset=to_our_order(nominal, joint_map),
        action_scale=to_our_order(file.numbers("action_scale", JOINTS), joint_map),
        target_low=(-UNBOUNDED,) * JOINTS,
        target_high=(UNBOUNDED,) * JOINTS,
        kp=to_our_order(file.gains("joint_stiffness", "kp"), joint_map),
        kd=to_our_order(file.gains("joint_damping", "kd"), joint_map),
        rate_hz=rate_hz,
        command_limits=limits,
        output=output,
    )


def _values(name: str, text: str) -> object:
    """Parse a text with commas: numbers or names; a text that is neither stays as it is."""
    parts = [part.strip() for part in text.split(",")]
    if name not in NUMBER_FIELDS:
        return parts
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        return text
    return numbers[0] if len(numbers) == 1 else numbers


def _term(file: Section, name: str, nominal: tuple[float, ...]) -> ImportedTerm:
    """Create a term of the newest step, without scale and bounds."""
    if name not in TERMS:
        file.refuse(
            "observation_names", f"only terms that can be supplied ({', '.join(TERMS)}), not {name!r}"
        )
    ours = TERMS[name]
    size = TERM_SIZES[ours]
    return ImportedTerm(name=ours, offset=nominal if ours == "q" else (0.0,) * size, scale=(1.0,) * size)
