"""Names of nodes, topics and services: validation, expansion, remapping."""

from __future__ import annotations

import re
from collections.abc import Iterable

from quadvel_dds.arguments import Rule

TOKEN = r"[A-Za-z_][A-Za-z0-9_]*"
NODE = re.compile(TOKEN)
ABSOLUTE = re.compile(rf"/|(/{TOKEN})+")
TOPIC = re.compile(
    rf"(~|~?/)?({TOKEN}|\{{(node|ns|namespace)\}})((/|(?=\{{)|(?<=\}}))({TOKEN}|\{{(node|ns|namespace)\}}))*|~"
)


def fault(pattern: re.Pattern[str], name: str) -> tuple[str, int] | None:
    """Validate a name.

    Args:
        pattern: Pattern of valid names: NODE, ABSOLUTE or TOPIC.
        name: The name.

    Returns:
        Reason and position of the error, or None.
    """
    if pattern.fullmatch(name):
        return None
    if not name:
        return "must not be empty", 0
    longest = max((i for i in range(len(name)) if pattern.fullmatch(name[:i])), default=0)
    return "must be made of letters, digits and underscores, in parts that start with no digit", longest


def expand(name: str, node: str, namespace: str) -> str:
    """Expand an absolute, relative or private (~) name of a topic or service.

    Args:
        name: The name.
        node: Name of the node that uses it.
        namespace: Namespace of that node.

    Returns:
        Full name.
    """
    for key, value in {"{node}": node, "{ns}": namespace, "{namespace}": namespace}.items():
        name = name.replace(key, value)
    base = namespace.rstrip("/")
    if name == "~" or name.startswith("~/"):
        name = f"{base}/{node}{name[1:]}"
    return name if name.startswith("/") else f"{base}/{name}"


def remap(full_name: str, node: str, namespace: str, rules: Iterable[Rule]) -> str:
    """Apply the first matching remapping rule.

    Args:
        full_name: Full name of a topic or service.
        node: Name of the node that uses it.
        namespace: Namespace of that node.
        rules: Remapping rules; both sides are expanded as names of this node.

    Returns:
        Full name after remapping.
    """
    for rule in rules:
        applies = rule.node in (None, node) and not rule.name.startswith("__")
        if applies and expand(rule.name, node, namespace) == full_name:
            return expand(rule.value, node, namespace)
    return full_name


def remap_node(node: str, namespace: str, rules: Iterable[Rule]) -> tuple[str, str]:
    """Apply `__node:=` (or `__name:=`) and `__ns:=`.

    Args:
        node: Name of a node.
        namespace: Namespace of the node.
        rules: Remapping rules.

    Returns:
        Name and namespace after remapping.
    """
    for rule in rules:
        if rule.node in (None, node):
            if rule.name in ("__node", "__name"):
                node = rule.value
            elif rule.name == "__ns":
                namespace = rule.value
    return node, namespace


def ros_type(dds_type: str) -> str:
    """Convert the name of a type on the wire.

    Args:
        dds_type: Name such as `pkg::msg::dds_::Name_`.

    Returns:
        Name such as `pkg/msg/Name`.
    """
    return dds_type.replace("::dds_::", "/").replace("::", "/").rstrip("_")
