"""What a process tells about its nodes on `ros_discovery_info`, so that `ros2 node list` knows them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from quadvel_dds import messages, wire

from .qos import DurabilityPolicy, QoSProfile

Gid: Any = messages.message_class("rmw_dds_common/msg/Gid")
NodeEntitiesInfo: Any = messages.message_class("rmw_dds_common/msg/NodeEntitiesInfo")
ParticipantEntitiesInfo: Any = messages.message_class("rmw_dds_common/msg/ParticipantEntitiesInfo")


class GraphAnnouncer:
    def __init__(self, participant: wire.Participant) -> None:
        self._gid = participant.gid
        profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._writer = participant.writer("ros_discovery_info", ParticipantEntitiesInfo.TYPENAME, profile)

    def announce(self, nodes: Iterable[Any]) -> None:
        """Publish names and endpoints of all nodes of this process; called whenever one of them changes."""
        message = ParticipantEntitiesInfo(gid=Gid(data=list(self._gid)))
        message.node_entities_info_seq = [_node_info(node) for node in nodes]
        self._writer.write(messages.serialize(message))


def _node_info(node: Any) -> Any:
    calls = [entity._endpoint for entity in (*node.clients, *node.services)]
    readers = [*(one._reader for one in node.subscriptions), *(call.reader for call in calls)]
    writers = [*(one._writer for one in node.publishers), *(call.writer for call in calls)]
    return NodeEntitiesInfo(
        node_namespace=node.get_namespace(),
        node_name=node.get_name(),
        reader_gid_seq=[
            Gid(data=list(reader.gid)) for reader in readers if reader is not None
        ],  # None: destroyed
        writer_gid_seq=[Gid(data=list(writer.gid)) for writer in writers if writer is not None],
    )
