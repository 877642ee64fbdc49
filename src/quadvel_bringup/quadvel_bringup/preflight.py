"""Check of a stack's parameters and files before any process starts.

An error is one sentence, instead of one per node. The nodes check again when they start; this
module builds the same records from the same values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import attrs

import quadvel_dds
from quadvel_dds.arguments import InvalidROSArgsError, ParameterOverride, parse, read_parameter_file
from quadvel_description.robot import load_robot
from quadvel_nodes.parameters import make_record, parameter_fields

from .nodes import NODES, installed_node, node_entry
from .stack import PARAMETERS, Stack

RCLPY_PARAMETERS = ("use_sim_time", "start_type_description_service")
"""Parameters that every node has."""


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
    """Check the limits, and load the policy; a shipped one has to exist."""
    from quadvel_policy.policy_file import chosen_policy, shipped_policy

    robot = load_robot(settings.robot)
    settings.control.supervisor.check(robot)
    return chosen_policy(robot, settings.policy) if settings.policy else shipped_policy(robot)


def _estimator(settings: Any) -> object:
    """Make the estimator; a shipped one has to exist."""
    from quadvel_estimator.learned import shipped_estimator

    robot = load_robot(settings.robot)
    if settings.kind == "learned" and not settings.model:
        return shipped_estimator(robot)
    return settings.make_estimator(robot)


# Skip the shipped networks: they are tested and slow to load.
NODE_CHECKS = {
    "sim_node": NodeCheck("quadvel_sim.parameters:SimParameters", lambda settings: settings.config()),
    "board": NodeCheck(
        "quadvel_sim.parameters:BoardParameters",
        lambda settings: (
            load_robot(settings.robot).require_board(),
            settings.config(),
            settings.calibration(),
        ),
    ),
    "driver": NodeCheck(
        "quadvel_driver.parameters:DriverParameters",
        lambda settings: (load_robot(settings.robot).require_board(), settings.load_calibration()),
    ),
    "estimator": NodeCheck("quadvel_estimator.estimator:EstimatorParameters", _estimator),
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
    overrides = _check_file(stack.parameters)
    arguments = stack.arguments()
    checked = [name for name in arguments if name in NODE_CHECKS]
    for name in checked:
        installed_node(name)
        values = {one.name: one.value for one in overrides if one.applies_to(f"/{name}")}
        try:
            _record(name, NODE_CHECKS[name], values)
        except ValueError as error:
            raise ValueError(f"{stack.parameters}: {error}") from None
    # The controller comes first: a robot without a policy needs no estimator.
    settings = {name: check_node(name, arguments[name]) for name in sorted(checked, key="controller".__ne__)}
    _check_same_robot({name: settings[name].robot for name in checked if hasattr(settings[name], "robot")})


def check_node(name: str, arguments: Sequence[str]) -> Any:
    """Check one node of NODE_CHECKS.

    Args:
        name: The node.
        arguments: Its arguments of ROS 2.

    Returns:
        The record of its parameters.
    """
    installed_node(name)
    return _check(name, NODE_CHECKS[name], parse(arguments).parameters_for(f"/{name}"))


def _check_same_robot(robots: Mapping[str, str]) -> None:
    """Check that all nodes are those of one robot; `robots`: by name of the node, the robot's own first."""
    first, *others = robots
    for name in others:
        if robots[name] != robots[first]:
            raise ValueError(
                f"{name}: robot is {robots[name]!r}, expected {robots[first]!r}, the robot of {first}"
            )


def check_arguments(name: str, arguments: Sequence[str]) -> None:
    """Check that the arguments of one node name only nodes and parameters that exist.

    A node itself ignores sections for others, so a misspelt one would have no effect.

    Args:
        name: The node, which may be renamed by a remapping.
        arguments: Its arguments of ROS 2. Malformed ones are left to its middleware.

    Raises:
        ValueError: There is no such node or parameter; the sentence has the nearest name.
    """
    node_entry(name)
    try:
        found = parse(arguments)
    except InvalidROSArgsError:
        return
    names = {node: node for node in NODES}
    names |= {rule.value: name for rule in found.remappings if rule.name == "__node"}
    namespaces = {override.pattern.rpartition("/")[0] for override in found.overrides}
    _check_names(
        found.overrides,
        {f"{space}/{own}": node for space in namespaces for own, node in names.items()},
        running=name,
    )


def _check_file(file: Path) -> Sequence[ParameterOverride]:
    """Read a parameter file; check that it names only nodes and parameters that exist, also of nodes that do not start."""
    try:
        overrides = read_parameter_file(file)
    except ValueError as error:
        raise ValueError(" ".join(str(error).split())) from None  # errors of YAML have several lines
    if not overrides:
        raise ValueError(f"{file}: found no section with parameters, expected one of {', '.join(NODES)}")
    try:
        _check_names(overrides, {f"/{node}": node for node in NODES})
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    return overrides


def _check_names(overrides: Iterable[ParameterOverride], nodes: Mapping[str, str], running: str = "") -> None:
    """Check names of nodes and parameters.

    Args:
        overrides: The parameters.
        nodes: Key in NODES by full name.
        running: The only node that runs, whose parameters an error then lists; "" for all.
    """
    for override in overrides:
        meant = {node for full_name, node in nodes.items() if override.applies_to(full_name)}
        if not meant:
            hint = _hint(override.pattern.rpartition("/")[2], NODES)
            raise ValueError(f"found a section for '{override.pattern}', {hint}")
        known = [name for node in NODES if node in meant for name in _parameter_names()[node]]
        if override.name not in known and not _is_of_rclpy(override.name):
            meant = {running} if running in meant else meant
            place = meant.pop() if len(meant) == 1 else override.pattern
            listed = _parameter_names().get(place, list(dict.fromkeys(known)))
            raise ValueError(f"{place}: found the parameter {override.name}, {_hint(override.name, listed)}")
        owners = [node for node in NODES if override.name in _parameter_names()[node]]
        others = sorted(meant - {*owners})
        if others and not running and not _is_of_rclpy(override.name):
            raise ValueError(
                f"found {override.name} in the section {override.pattern}, but {others[0]} has no such parameter: "
                f"expected it in the section {' or '.join(owners)}"
            )


@cache
def _parameter_names() -> dict[str, list[str]]:
    """Return the parameters of each node: the shipped parameter file holds them all."""
    names: dict[str, list[str]] = {node: [] for node in NODES}
    for override in read_parameter_file(PARAMETERS):
        names[override.pattern.strip("/")].append(override.name)
    return names


def _is_of_rclpy(parameter: str) -> bool:
    return parameter in RCLPY_PARAMETERS or parameter.startswith("qos_overrides.")


def _hint(found: str, known: Iterable[str]) -> str:
    """Return the nearest name, or all names if none is near."""
    near = get_close_matches(found, [*known], 1)
    return f"did you mean {near[0]}?" if near else f"expected one of {', '.join(known)}"


def _expected(wanted: type[Any], value: Any) -> str:
    """Name a type, and for a whole number the spelling with which ROS 2 reads a float."""
    if wanted is float and type(value) is int:
        return f"a float: write {value}.0"
    return "a list" if wanted is tuple else f"a {wanted.__name__}"


def _check(name: str, part: NodeCheck, values: Mapping[str, Any]) -> Any:
    """Check the parameters of a node, and that it can be made from them; return their record."""
    settings = _record(name, part, values)
    try:
        part.make(settings)
    except ValueError as error:
        raise ValueError(f"{name}: {error.args[0]}") from error
    return settings


def _record(name: str, part: NodeCheck, values: Mapping[str, Any]) -> Any:
    """Check names, types and ranges of the parameters of a node; return their record."""
    module, _, record = part.record.partition(":")
    kind = getattr(import_module(module), record)
    defaults = {name: field.default for name, field in parameter_fields(kind).items()}
    for parameter, value in values.items():
        if _is_of_rclpy(parameter):
            continue
        if parameter not in defaults:
            raise ValueError(f"{name}: found the parameter {parameter}, {_hint(parameter, defaults)}")
        wanted = type(defaults[parameter])
        if wanted is not (tuple if isinstance(value, list) else type(value)):
            raise ValueError(f"{name}: {parameter} is {value!r}, expected {_expected(wanted, value)}")
    given = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items() if key in defaults}
    try:
        return make_record(kind, given)
    except ValueError as error:
        raise ValueError(f"{name}: {error.args[0]}") from error
