"""What is wrong with a stack's parameters and files, found before a process starts: one sentence instead of four.

The nodes look for themselves once more when they start; here the same records are made of the same values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import attrs

import quadvel_dds
from quadvel_dds.arguments import parse, read_parameter_file

from .nodes import NODES
from .stack import Stack


@attrs.frozen
class Part:
    """The record of a node's parameters, and what the node makes of it that may fail."""

    record: str
    make: Callable[[Any], object]


def _policy(settings: Any) -> object:
    from quadvel_policy.policy_file import PolicyFile

    return PolicyFile(Path(settings.policy)) if settings.policy else None


# The shipped networks are as they were shipped; loading them would only take time.
PARTS = {
    "sim_node": Part("quadvel_sim.parameters:SimParameters", lambda settings: settings.config()),
    "board": Part(
        "quadvel_sim.parameters:BoardParameters", lambda settings: (settings.config(), settings.off())
    ),
    "driver": Part(
        "quadvel_driver.parameters:DriverParameters", lambda settings: settings.load_calibration()
    ),
    "estimator": Part(
        "quadvel_estimator.estimator:EstimatorParameters",
        lambda settings: settings.make_estimator() if settings.model else None,
    ),
    "controller": Part("quadvel_policy.controller:ControllerParameters", _policy),
    "command_mux": Part("quadvel_policy.command_mux_node:MuxParameters", lambda settings: settings.inputs()),
}


def rehearse(stack: Stack) -> None:
    """Raises ValueError, which names the node and the parameter, or OSError where the stack could not start."""
    quadvel_dds.install()
    _check_names(stack.parameters)
    for name, arguments in stack.arguments().items():
        if name in PARTS:
            rehearse_node(name, arguments)


def rehearse_node(name: str, arguments: Sequence[str]) -> None:
    """The same for one node of PARTS with these arguments of ROS 2."""
    _check(name, PARTS[name], parse(arguments).parameters_for(f"/{name}"))


def _check_names(file: Path) -> None:
    """That each section of the parameter file is meant for one of our nodes."""
    try:
        overrides = read_parameter_file(file)
    except ValueError as error:
        raise ValueError(" ".join(str(error).split())) from None  # YAML tells its errors in several lines
    if not overrides:
        raise ValueError(f"{file}: found no section with parameters, expected one of {', '.join(NODES)}")
    for pattern in dict.fromkeys(override.pattern for override in overrides):
        of_it = next(override for override in overrides if override.pattern == pattern)
        if not any(of_it.applies_to(f"/{name}") for name in NODES):
            raise ValueError(f"{file}: found a section for '{pattern}', expected one of {', '.join(NODES)}")


def _check(name: str, part: Part, values: Mapping[str, Any]) -> None:
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
