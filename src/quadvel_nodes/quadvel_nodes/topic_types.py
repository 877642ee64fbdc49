"""Detection of publishers whose type differs from the subscriptions. For node files.

`node` watches the topics of each node with it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import attrs

CHECK_PERIOD_S = 2.0
"""s between two checks of the topics of a node."""
REMEDIES = {
    (
        "geometry_msgs/msg/TwistStamped",
        "geometry_msgs/msg/Twist",
    ): "; the command mux takes it with stamped: true in its parameter file",
    (
        "geometry_msgs/msg/Twist",
        "geometry_msgs/msg/TwistStamped",
    ): "; the command mux takes it with stamped: false in its parameter file",
}


@attrs.frozen
class TypeConflict:
    """A topic whose published type is not the expected one.

    Attributes:
        topic: Name of the topic.
        published: Type that is published, such as `geometry_msgs/msg/Twist`.
        expected: Type that is subscribed.
    """

    topic: str
    published: str
    expected: str

    def __str__(self) -> str:
        remedy = REMEDIES.get((self.published, self.expected), "")
        return f"{self.topic}: {self.published} is published, {self.expected} is expected: nothing is heard{remedy}"


def conflicts_of(node: Any) -> list[TypeConflict]:
    """Find type conflicts on the topics to which a node subscribes.

    Args:
        node: The node.

    Returns:
        The conflicts, sorted by topic.
    """
    return _conflicts(node, ((one.topic_name, _type_name(one.msg_type)) for one in node.subscriptions))


def all_conflicts(node: Any) -> list[TypeConflict]:
    """Find type conflicts on all topics that a node knows.

    Args:
        node: The node that queries the ROS graph.

    Returns:
        The conflicts, sorted by topic.
    """
    doubtful = [topic for topic, types in node.get_topic_names_and_types() if len(types) > 1]
    expected = (
        (topic, one.topic_type) for topic in doubtful for one in node.get_subscriptions_info_by_topic(topic)
    )
    return _conflicts(node, expected)


def _conflicts(node: Any, expected: Iterable[tuple[str, str]]) -> list[TypeConflict]:
    """Return the conflicts between the expected (topic, type) pairs and the publishers, sorted."""
    found = {
        TypeConflict(topic, publisher.topic_type, kind)
        for topic, kind in expected
        for publisher in node.get_publishers_info_by_topic(topic)
        if publisher.topic_type != kind
    }
    return sorted(found, key=str)


def _type_name(kind: type) -> str:
    """Return the ROS name of a message class."""
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"


class ConflictWatch:
    """Logs a warning when a new type conflict appears on a topic of a node."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._known: set[TypeConflict] = set()

    def check(self) -> None:
        """Log each new conflict; to be called every CHECK_PERIOD_S."""
        found = set(conflicts_of(self._node))
        for conflict in sorted(found - self._known, key=str):
            self._node.get_logger().warning(str(conflict))
        self._known = found
