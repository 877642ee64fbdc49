"""Command-line arguments of a ROS 2 process: parameters, parameter files, remappings, log levels."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import attrs
import yaml

from quadvel_dds.errors import UnsupportedError

SCOPE_KEY = "ros__parameters"
IGNORED_FLAGS = {f"--{on}-{what}" for on in ("enable", "disable") for what in ("rosout-logs", "stdout-logs")}
IGNORED_FLAGS |= {"--enable-external-lib-logs", "--disable-external-lib-logs"}


class InvalidROSArgsError(ValueError):
    """What follows --ros-args is not understood."""


@attrs.frozen
class Rule:
    """One `[node:]from:=to` or `[node:]parameter:=value`."""

    node: str | None
    name: str
    value: str


@attrs.frozen
class ParameterOverride:
    """A value for the parameter `name` of the nodes whose full name matches `pattern`."""

    pattern: str
    name: str
    value: Any

    def applies_to(self, full_name: str) -> bool:
        return re.fullmatch(_pattern_expression(self.pattern), full_name) is not None


@attrs.define
class RosArguments:
    """What was found between --ros-args and -- (or the end)."""

    remappings: list[Rule] = attrs.field(factory=list)
    overrides: list[ParameterOverride] = attrs.field(factory=list)
    log_levels: dict[str, str] = attrs.field(factory=dict)  # logger name ("" = default) to level
    rest: list[str] = attrs.field(factory=list)  # what is no ROS argument

    def parameters_for(self, full_name: str) -> dict[str, Any]:
        """Overrides of a node ("/ns/name"), later ones first in rank."""
        return {o.name: o.value for o in self.overrides if o.applies_to(full_name)}


def parse(args: Sequence[str]) -> RosArguments:
    """Read a command line. Raises InvalidROSArgsError that names what is at fault."""
    found = RosArguments()
    within = False
    arguments = iter(args)
    for argument in arguments:
        if argument == "--ros-args":
            within = True
        elif within and argument == "--":
            within = False
        elif within:
            _parse_one(argument, arguments, found)
        else:
            found.rest.append(argument)
    return found


def _parse_one(flag: str, following: Iterable[str], found: RosArguments) -> None:
    if flag in IGNORED_FLAGS:
        return
    takers = {
        "-p": "-p",
        "--param": "-p",
        "-r": "-r",
        "--remap": "-r",
        "--params-file": "file",
        "--log-level": "log",
    }
    kind = takers.get(flag)
    if kind is None and ":=" in flag and not flag.startswith("-"):
        found.remappings.append(parse_rule(flag, flag))  # a bare rule, the old way to remap
        return
    if kind is None:
        if flag in ("-e", "--enclave", "--log-config-file", "--log-file-name"):
            raise UnsupportedError(f"argument {flag}")
        raise InvalidROSArgsError(f"unknown ROS argument '{flag}'")
    value = next(iter(following), None)
    if value is None:
        raise InvalidROSArgsError(f"argument {flag} needs a value")
    if kind == "-p":
        rule = parse_rule(flag, value)
        pattern = f"/**/{rule.node}" if rule.node else "/**"
        found.overrides.append(
            ParameterOverride(pattern, rule.name, parse_value(f"{flag} {value}", rule.value))
        )
    elif kind == "-r":
        found.remappings.append(parse_rule(flag, value))
    elif kind == "file":
        found.overrides += read_parameter_file(Path(value))
    else:
        name, _, level = value.rpartition(":=")
        found.log_levels[name] = level


def parse_rule(flag: str, text: str) -> Rule:
    left, separator, right = text.partition(":=")
    node, _, name = left.rpartition(":")
    if not separator or not name or re.match(r"ros(topic|service)://", left):
        raise InvalidROSArgsError(f"argument {flag}: found '{text}', expected [node:]name:=value")
    return Rule(node or None, name, right)


class _Loader(yaml.SafeLoader):
    """YAML as ROS 2 reads it: 1e-3 is a number, a date is not."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d[\d_]*)(\.\d*)?[eE][-+]?\d+"), list("-+0123456789")
)


def parse_value(where: str, text: str) -> Any:
    """A parameter value from YAML text. Raises InvalidROSArgsError."""
    try:
        value = yaml.load(text, _Loader) if text else ""
    except yaml.YAMLError as error:
        raise InvalidROSArgsError(f"{where}: '{text}' is not valid YAML: {error}") from error
    return check_value(where, value)


def check_value(where: str, value: Any) -> Any:
    """The value, if a parameter can hold it: a bool, int, float, string or a list of one of these."""
    types = {type(item) for item in value} if isinstance(value, list) else {type(value)}
    if len(types) > 1 or not types <= {bool, int, float, str}:
        raise InvalidROSArgsError(
            f"{where}: found {value!r}, expected a bool, integer, float, string or a list of one of these"
        )
    return value


def read_parameter_file(path: Path) -> list[ParameterOverride]:
    """Overrides of a YAML file. Raises InvalidROSArgsError that names the file and the key at fault."""
    try:
        document = yaml.load(path.read_text(), _Loader)
    except OSError as error:
        raise InvalidROSArgsError(f"parameter file '{path}' cannot be read: {error.strerror}") from error
    except yaml.YAMLError as error:
        raise InvalidROSArgsError(f"parameter file '{path}' is not valid YAML: {error}") from error
    if document is None:
        return []
    overrides = list(_walk_nodes(path, "", document))
    return overrides


def _walk_nodes(path: Path, prefix: str, tree: Any) -> Iterable[ParameterOverride]:
    if not isinstance(tree, dict):
        where = f" under '{prefix}'" if prefix else ""
        raise InvalidROSArgsError(
            f"parameter file '{path}': found {tree!r}{where}, expected node names with '{SCOPE_KEY}' below"
        )
    for key, branch in tree.items():
        if key != SCOPE_KEY:
            yield from _walk_nodes(path, f"{prefix}/{str(key).strip('/')}", branch)
        elif not isinstance(branch, dict):
            raise InvalidROSArgsError(
                f"parameter file '{path}': '{prefix}' {SCOPE_KEY}: expected names and values"
            )
        else:
            yield from (
                ParameterOverride(prefix, name, check_value(f"parameter file '{path}', '{name}'", value))
                for name, value in _flatten("", branch)
            )


def _flatten(prefix: str, branch: dict[Any, Any]) -> Iterable[tuple[str, Any]]:
    for key, value in branch.items():
        if isinstance(value, dict):
            yield from _flatten(f"{prefix}{key}.", value)
        else:
            yield f"{prefix}{key}", value


def _pattern_expression(pattern: str) -> str:
    """Regular expression of a node name with wildcards: * is one token of the name, ** any number of them."""
    parts = re.split(r"(/\*\*|\*)", pattern)
    meaning = {"/**": "(/[^/]+)*", "*": "[^/]+"}
    return "".join(meaning.get(part, re.escape(part)) for part in parts)
