"""Publishers whose messages nobody hears, as they are of another type than the subscriptions of their topic. For node files."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import attrs

PERIOD = 2.0
"""s between two looks of a node at its topics"""
REMEDIES = {
    (
        "geometry_msgs/msg/TwistStamped",
        "geometry_msgs/msg/Twist",
    ): "; the command mux takes it with -p stamped:=true",
    (
        "geometry_msgs/msg/Twist",
        "geometry_msgs/msg/TwistStamped",
    ): "; the command mux takes it with -p stamped:=false",
}


@attrs.frozen
class TypeConflict:
    """A topic, the type that is published on it, and the type that is expected (both as `geometry_msgs/msg/Twist`)."""

    topic: str
    published: str
    expected: str

    def __str__(self) -> str:
        remedy = REMEDIES.get((self.published, self.expected), "")
        return f"{self.topic}: {self.published} is published, {self.expected} is expected: nothing is heard{remedy}"


def conflicts_of(node: Any) -> list[TypeConflict]:
    """Those on the topics to which this node subscribes."""
    return _conflicts(node, ((one.topic_name, _name(one.msg_type)) for one in node.subscriptions))


def all_conflicts(node: Any) -> list[TypeConflict]:
    """Those on all topics that `node` knows of."""
    doubtful = [topic for topic, types in node.get_topic_names_and_types() if len(types) > 1]
    expected = (
        (topic, one.topic_type) for topic in doubtful for one in node.get_subscriptions_info_by_topic(topic)
    )
    return _conflicts(node, expected)


def _conflicts(node: Any, expected: Iterable[tuple[str, str]]) -> list[TypeConflict]:
    found = {
        TypeConflict(topic, publisher.topic_type, kind)
        for topic, kind in expected
        for publisher in node.get_publishers_info_by_topic(topic)
        if publisher.topic_type != kind
    }
    return sorted(found, key=str)


def _name(kind: type) -> str:
    """The name of a message class."""
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"


class ConflictWatch:
    """Warns of each conflict on the topics of a node when it begins."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._known: set[TypeConflict] = set()

    def look(self) -> None:
        """To be called every PERIOD."""
        found = set(conflicts_of(self._node))
        for conflict in sorted(found - self._known, key=str):
            self._node.get_logger().warning(str(conflict))
        self._known = found
