"""Check of a stack's parameters and files before any process starts.

An error is one sentence, instead of one per node. The nodes check again when they start; this
module builds the same records from the same values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import attrs

import quadvel_dds
from quadvel_dds.arguments import parse, read_parameter_file

from .nodes import NODES, installed_node
from .stack import Stack


@attrs.frozen
class NodeCheck:
    """A node's parameter record and the construction that may fail.

    Attributes:
        record: "module:class" of the record.
        make: Makes from the record what the node would make.
    """

    record: str
    make: Callable[[Any], object]


def _policy(settings: Any) -> object:
    """Load the policy, if one is given."""
    from quadvel_policy.policy_file import PolicyFile

    return PolicyFile(Path(settings.policy)) if settings.policy else None


# Skip the shipped networks: they are tested and slow to load.
NODE_CHECKS = {
    "sim_node": NodeCheck("quadvel_sim.parameters:SimParameters", lambda settings: settings.config()),
    "board": NodeCheck(
        "quadvel_sim.parameters:BoardParameters", lambda settings: (settings.config(), settings.calibration())
    ),
    "driver": NodeCheck(
        "quadvel_driver.parameters:DriverParameters", lambda settings: settings.load_calibration()
    ),
    "estimator": NodeCheck(
        "quadvel_estimator.estimator:EstimatorParameters",
        lambda settings: settings.make_estimator() if settings.model else None,
    ),
    "controller": NodeCheck("quadvel_policy.controller:ControllerParameters", _policy),
    "command_mux": NodeCheck(
        "quadvel_policy.command_mux_node:MuxParameters", lambda settings: settings.inputs()
    ),
}


def check_stack(stack: Stack) -> None:
    """Check a stack. Errors pass through: ValueError names node and parameter, OSError the file.

    Args:
        stack: The nodes and their parameters.
    """
    quadvel_dds.install()
    _check_names(stack.parameters)
    for name, arguments in stack.arguments().items():
        if name in NODE_CHECKS:
            check_node(name, arguments)


def check_node(name: str, arguments: Sequence[str]) -> None:
    """Check one node of NODE_CHECKS.

    Args:
        name: The node.
        arguments: Its arguments of ROS 2.
    """
    installed_node(name)
    _check(name, NODE_CHECKS[name], parse(arguments).parameters_for(f"/{name}"))


def _check_names(file: Path) -> None:
    """Check that each section of a parameter file belongs to a node."""
    try:
        overrides = read_parameter_file(file)
    except ValueError as error:
        raise ValueError(" ".join(str(error).split())) from None  # errors of YAML have several lines
    if not overrides:
        raise ValueError(f"{file}: found no section with parameters, expected one of {', '.join(NODES)}")
    for pattern in dict.fromkeys(override.pattern for override in overrides):
        of_it = next(override for override in overrides if override.pattern == pattern)
        if not any(of_it.applies_to(f"/{name}") for name in NODES):
            raise ValueError(f"{file}: found a section for '{pattern}', expected one of {', '.join(NODES)}")


def _check(name: str, part: NodeCheck, values: Mapping[str, Any]) -> None:
    """Check names, types and values of the parameters of a node."""
    module, _, record = part.record.partition(":")
    kind = getattr(import_module(module), record)
    defaults = {field.name: field.default for field in attrs.fields(kind)}
    for parameter, value in values.items():
        if parameter == "use_sim_time" or parameter.startswith("qos_overrides."):
            continue
        if parameter not in defaults:
            raise ValueError(
                f"{name}: found the parameter {parameter}, expected one of {', '.join(defaults)}"
            )
        wanted = type(defaults[parameter])
        if wanted is not (tuple if isinstance(value, list) else type(value)):
            expected = "list" if wanted is tuple else wanted.__name__
            raise ValueError(f"{name}: {parameter} is {value!r}, expected a {expected}")
    given = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items() if key in defaults}
    try:
        part.make(kind(**given))
    except ValueError as error:
        raise ValueError(f"{name}: {error.args[0]}") from error
