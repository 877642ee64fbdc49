"""Announcement of this process's nodes on `ros_discovery_info`, for `ros2 node list`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rmw_dds_common.msg import Gid, NodeEntitiesInfo, ParticipantEntitiesInfo

from quadvel_dds import messages, wire

from .qos import DurabilityPolicy, QoSProfile

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class GraphAnnouncer:
    """Publishes names and endpoints of this process's nodes."""

    def __init__(self, participant: wire.Participant) -> None:
        """Create the writer.

        Args:
            participant: Participant of this process.
        """
        self._gid = participant.gid
        self._writer = participant.writer("ros_discovery_info", ParticipantEntitiesInfo.TYPENAME, LATCHED)

    def announce(self, nodes: Iterable[Any]) -> None:
        """Publish names and endpoints; to be called after every change.

        Args:
            nodes: All nodes of this process.
        """
        message = ParticipantEntitiesInfo(gid=Gid(data=list(self._gid)))
        message.node_entities_info_seq = [_node_info(node) for node in nodes]
        self._writer.write(messages.serialize(message))


def _node_info(node: Any) -> Any:
    """Return names and endpoints of a node as a message."""
    calls = [entity._endpoint for entity in (*node._clients, *node._services)]
    readers = [*(one._reader for one in node._subscriptions), *(call.reader for call in calls)]
    writers = [one._writer for one in node._publishers if one._writer is not None]  # None: destroyed
    writers += [call.writer for call in calls]
    info = NodeEntitiesInfo(node_namespace=node.get_namespace(), node_name=node.get_name())
    info.reader_gid_seq = [Gid(data=list(reader.gid)) for reader in readers]
    info.writer_gid_seq = [Gid(data=list(writer.gid)) for writer in writers]
    return info
