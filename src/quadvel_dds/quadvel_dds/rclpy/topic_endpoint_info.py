"""What discovery knows of a publisher or subscription: the type of its topic."""

from __future__ import annotations

from quadvel_dds.errors import Partial


class TopicEndpointInfo(Partial):
    def __init__(self, topic_type: str) -> None:
        self.topic_type = topic_type
