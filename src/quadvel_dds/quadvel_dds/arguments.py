"""ROS arguments of a command line: parameters, parameter files, remappings, log levels.

`rclpy.context` parses the command line with it, and `names` applies the remappings.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
import yaml

from quadvel_description.bounded_yaml import BoundedLoader, load_yaml, read_bounded_text

SCOPE_KEY = "ros__parameters"
FLAGS = {
    "-p": "p", "--param": "p", "-r": "r", "--remap": "r", "--params-file": "file", "--log-level": "log",
    "-e": "enclave", "--enclave": "enclave",
}  # fmt: skip
IGNORED_FLAGS = {f"--{on}-{what}" for on in ("enable", "disable") for what in ("rosout-logs", "stdout-logs")}


class InvalidROSArgsError(ValueError):
    """The arguments after --ros-args are invalid."""


@attrs.frozen
class Rule:
    """A rule `[node:]from:=to` or `[node:]parameter:=value`.

    Attributes:
        node: Name of the node that the rule applies to; None: all nodes.
        name: Name that is replaced or set.
        value: New name or value.
    """

    node: str | None
    name: str
    value: str


@attrs.frozen
class ParameterOverride:
    """Value of a parameter for the nodes whose full names match a pattern.

    Attributes:
        pattern: Full node name; `*` matches one token, `/**` any number of tokens.
        name: Name of the parameter.
        value: Value of the parameter.
    """

    pattern: str
    name: str
    value: Any

    def applies_to(self, full_name: str) -> bool:
        """Return whether the override applies to a node.

        Args:
            full_name: Full name of the node, such as `/ns/name`.

        Returns:
            Whether the pattern matches.
        """
        meaning = {"/**": "(/[^/]+)*", "*": "[^/]+"}
        parts = re.split(r"(/\*\*|\*)", self.pattern)
        return (
            re.fullmatch("".join(meaning.get(part, re.escape(part)) for part in parts), full_name) is not None
        )


@attrs.define
class RosArguments:
    """Arguments between --ros-args and -- (or the end).

    Attributes:
        remappings: Remapping rules.
        overrides: Parameter overrides.
        log_levels: Log level by logger name; the name "" is the default.
    """

    remappings: list[Rule] = attrs.field(factory=list)
    overrides: list[ParameterOverride] = attrs.field(factory=list)
    log_levels: dict[str, str] = attrs.field(factory=dict)

    def parameters_for(self, full_name: str) -> dict[str, Any]:
        """Return the parameter overrides of a node; a later override replaces an earlier one.

        Args:
            full_name: Full name of the node, such as `/ns/name`.

        Returns:
            Values by parameter name.
        """
        return {o.name: o.value for o in self.overrides if o.applies_to(full_name)}


def parse(args: Sequence[str]) -> RosArguments:
    """Parse a command line.

    Args:
        args: Command line; arguments outside --ros-args are ignored.

    Returns:
        The ROS arguments. InvalidROSArgsError propagates; it names the wrong argument.
    """
    found = RosArguments()
    within = False
    arguments = iter(args)
    for argument in arguments:
        if argument == "--ros-args":
            within = True
        elif within and argument == "--":
            within = False
        elif within and argument not in IGNORED_FLAGS:
            _parse_one(argument, arguments, found)
    return found


def _parse_one(flag: str, following: Iterator[str], found: RosArguments) -> None:
    """Parse one flag with its value."""
    if flag not in FLAGS:
        raise InvalidROSArgsError(f"ROS argument '{flag}' is not known, or not offered here")
    value = next(following, None)
    if value is None:
        raise InvalidROSArgsError(f"argument {flag} needs a value")
    if FLAGS[flag] == "p":
        rule = parse_rule(flag, value)
        pattern = f"/**/{rule.node}" if rule.node else "/**"
        parsed = parse_value(f"{flag} {value}", rule.value)
        found.overrides.append(ParameterOverride(pattern, rule.name, parsed))
    elif FLAGS[flag] == "r":
        found.remappings.append(parse_rule(flag, value))
    elif FLAGS[flag] == "file":
        found.overrides += read_parameter_file(Path(value))
    elif FLAGS[flag] == "log":
        name, _, level = value.rpartition(":=")
        found.log_levels[name] = level  # an enclave means nothing without security, which Context refuses


def parse_rule(flag: str, text: str) -> Rule:
    """Parse a rule.

    Args:
        flag: Flag in front of the rule, for the error message.
        text: The rule.

    Returns:
        The rule.

    Raises:
        InvalidROSArgsError: The text is no rule.
    """
    left, separator, right = text.partition(":=")
    node, _, name = left.rpartition(":")
    if not separator or not name or re.match(r"ros(topic|service)://", left):
        raise InvalidROSArgsError(f"argument {flag}: found '{text}', expected [node:]name:=value")
    return Rule(node or None, name, right)


class _Loader(BoundedLoader):
    """YAML loader with ROS 2's rules: 1e-3 is a number, dates are text, aliases are refused."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("found an alias, expected values in full, as in ROS 2")
        return super().compose_node(parent, index)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d[\d_]*)(\.\d*)?[eE][-+]?\d+"), list("-+0123456789")
)


def parse_value(where: str, text: str) -> Any:
    """Parse a parameter value.

    Args:
        where: Place of the value, for the error message.
        text: YAML text.

    Returns:
        The value. InvalidROSArgsError propagates.
    """
    return check_value(where, _load(where, text) if text else "")


def _load(where: str, text: str) -> Any:
    """Return the document of a YAML text."""
    try:
        return load_yaml(text, _Loader)
    except ValueError as error:
        raise InvalidROSArgsError(f"{where} is not valid YAML: {error}") from error


def check_value(where: str, value: Any) -> Any:
    """Check that a parameter can hold a value.

    Args:
        where: Place of the value, for the error message.
        value: The value.

    Returns:
        The value.

    Raises:
        InvalidROSArgsError: It is no bool, int, float, string or list of one of these.
    """
    types = {type(item) for item in value} if isinstance(value, list) else {type(value)}
    if len(types) > 1 or not types <= {bool, int, float, str}:
        raise InvalidROSArgsError(
            f"{where}: found {value!r}, expected a bool, integer, float, string or a list of one of these"
        )
    return value


def read_parameter_file(path: Path) -> list[ParameterOverride]:
    """Read the parameter overrides of a YAML file.

    Args:
        path: Path of the file.

    Returns:
        The overrides.

    Raises:
        InvalidROSArgsError: The file is unreadable or malformed; the message names file and key.
    """
    where = f"parameter file '{path}'"
    try:
        document = _load(where, read_bounded_text(path))
    except (OSError, UnicodeDecodeError) as error:
        fault = f"cannot be read: {error.strerror}" if isinstance(error, OSError) else "is not text"
        raise InvalidROSArgsError(f"{where} {fault}") from error
    return [] if document is None else list(_walk_nodes(where, "", document))


def _walk_nodes(where: str, prefix: str, tree: Any) -> Iterable[ParameterOverride]:
    """Yield the overrides of a tree of node names."""
    if not isinstance(tree, dict):
        below = f" under '{prefix}'" if prefix else ""
        raise InvalidROSArgsError(
            f"{where}: found {tree!r}{below}, expected node names with '{SCOPE_KEY}' below"
        )
    for key, branch in tree.items():
        if key != SCOPE_KEY:
            yield from _walk_nodes(where, f"{prefix}/{str(key).strip('/')}", branch)
        elif not isinstance(branch, dict):
            raise InvalidROSArgsError(f"{where}: '{prefix}' {SCOPE_KEY}: expected names and values")
        else:
            for name, value in _flatten("", branch):
                yield ParameterOverride(prefix, name, check_value(f"{where}, '{name}'", value))


def _flatten(prefix: str, branch: dict[Any, Any]) -> Iterable[tuple[str, Any]]:
    """Yield the parameters of nested mappings with dotted names."""
    for key, value in branch.items():
        if isinstance(value, dict):
            yield from _flatten(f"{prefix}{key}.", value)
        else:
            yield f"{prefix}{key}", value
