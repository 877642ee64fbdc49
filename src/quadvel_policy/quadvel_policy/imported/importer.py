"""Imports a policy: from weights and configuration to one ONNX file that runs here.

The network stays as it is; only its metadata changes.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import attrs

from quadvel_description.bounded_yaml import read_yaml
from quadvel_description.network_file import NetworkFileError, metadata_texts, read_network
from quadvel_description.onnx_format import Message, message, serialise
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot

from ..observation import Bounds
from . import mjlab, rl_sar, unitree_rl_lab
from .metadata import IMPORTED_KEY, ImportedMetadata
from .policy import ImportedPolicy
from .section import FormatError

ACTION_OUTPUT = "actions"
"""Name of the output with the action in most files; without it, the network must have one output."""
PICKLED = (".pt", ".pth", ".jit")


@attrs.frozen(kw_only=True)
class Supplement:
    """Values that a format may lack.

    Attributes:
        limits: Largest commands of the training, to either side: vx, vy (m/s), wz (rad/s); None:
            those of the format.
        rate_hz: Rate of the policy, Hz; None: that of the format.
    """

    limits: tuple[float, float, float] | None = None
    rate_hz: float | None = None


def import_policy(
    robot: Robot, weights: Path, config: Path | None = None, supplement: Supplement | None = None
) -> tuple[ImportedMetadata, bytes]:
    """Read a policy of another project.

    Args:
        robot: The robot of the policy.
        weights: Its ONNX file.
        config: Its deploy.yaml (unitree_rl_lab) or config.yaml (rl_sar); None: mjlab's metadata in
            the ONNX file.
        supplement: Values that the format lacks; None for nothing.

    Returns:
        What was read, and the content of the ONNX file for `ImportedPolicy`.

    Raises:
        ValueError: A file or a field is missing or does not fit; the message names file and field,
            the value found and the value expected.
    """
    fields = None if config is None else read_yaml(config, "a deploy.yaml or a config.yaml")
    reader = mjlab if config is None else _format_of(config, fields)
    if weights.suffix in PICKLED and weights.exists():
        raise NetworkFileError(
            f"{weights}: is a pickle, which can run code when it is opened, expected ONNX; where you trust it, "
            "export its network: torch.onnx.export(network, (torch.zeros(1, n),), 'policy.onnx', dynamo=False), with "
            "network = torch.jit.load(file) for TorchScript; a checkpoint has no network, only its weights"
        )
    model = read_network(weights)
    output, supplement = _action_output(weights, model), supplement or Supplement()
    if config is None:
        metadata = _read_mjlab(robot, weights, model, output, supplement)
    else:
        metadata = _read_config(robot, config, reader, fields, output, supplement)
    _check_posture(robot, f"{config or weights}: {reader.POSTURE_FIELD}", metadata)
    entry = message("StringStringEntryProto", key=IMPORTED_KEY, value=metadata.to_json())
    model = attrs.evolve(model, fields=model.fields | {"metadata_props": [entry]})
    ImportedPolicy(robot, weights, model)  # refuses a network that does not fit
    return metadata, serialise(model)


def _format_of(config: Path, fields: Any) -> ModuleType:
    """Return the module that reads the content of a configuration file."""
    if unitree_rl_lab.is_deploy_yaml(fields):
        return unitree_rl_lab
    if rl_sar.is_config(fields):
        return rl_sar
    raise FormatError(
        f"{config}: found no joint_ids_map and no single key 'robot/policy', expected "
        "unitree_rl_lab's deploy.yaml or rl_sar's config.yaml"
    )


def _read_mjlab(
    robot: Robot, weights: Path, model: Message, output: str, supplement: Supplement
) -> ImportedMetadata:
    """Read the metadata of the ONNX file."""
    metadata = metadata_texts(model)
    if not mjlab.is_mjlab(metadata):
        raise FormatError(
            f"{weights}: metadata: found {sorted(metadata) or 'nothing'}, expected mjlab's "
            "observation_names and joint_names, or a configuration file (--with)"
        )
    limits, rate = _limits(weights, supplement), supplement.rate_hz
    if rate is None:
        raise FormatError(f"{weights}: metadata.rate: found nothing, expected a rate in Hz (--rate)")
    return mjlab.read(weights, metadata, robot.name, output, limits, rate)


def _read_config(
    robot: Robot, config: Path, reader: ModuleType, fields: Any, output: str, supplement: Supplement
) -> ImportedMetadata:
    """Read the content of a configuration file."""
    if supplement.rate_hz is not None:
        raise FormatError(f"{config}: has its own rate, expected no --rate")
    if reader is unitree_rl_lab:
        if supplement.limits is not None:
            raise FormatError(f"{config}: commands: has its own ranges, expected no --limits")
        return unitree_rl_lab.read(config, fields, robot.name, output)
    return rl_sar.read(config, fields, robot.name, output, _limits(config, supplement))


def _limits(path: Path, supplement: Supplement) -> dict[str, Bounds]:
    """Return the command limits of a format that has none."""
    if supplement.limits is None:
        raise FormatError(
            f"{path}: command limits: found nothing, the format has none, expected those of the training "
            "(--limits VX VY WZ)"
        )
    return {axis: (-limit, limit) for axis, limit in zip(("vx", "vy", "wz"), supplement.limits, strict=True)}


def _action_output(weights: Path, model: Message) -> str:
    """Return the name of the output with the action."""
    names = [one.one("name", "") for one in model.one("graph").all("output")]
    if ACTION_OUTPUT in names:
        return ACTION_OUTPUT
    if len(names) != 1:
        raise FormatError(f"{weights}: outputs: found {names}, expected {ACTION_OUTPUT!r}, or one output")
    return str(names[0])


def _check_posture(robot: Robot, field: str, metadata: ImportedMetadata) -> None:
    """Refuse a default posture that the drives do not accept; `field`: its file and field."""
    for i, (low, q, high) in enumerate(
        zip(robot.command_lower, metadata.nominal_q, robot.command_upper, strict=True)
    ):
        if not low <= q <= high:
            place = f"{field}[{metadata.joint_map.index(i)}], {JOINT_NAMES[i]}"
            raise FormatError(f"{place}: found {q}, expected {low} to {high} rad")
