"""Description of a discovered publisher or subscription."""

from __future__ import annotations

from quadvel_dds.errors import Partial


class TopicEndpointInfo(Partial):
    """Discovered endpoint, see rclpy's TopicEndpointInfo.

    Attributes:
        topic_type: Type of the topic, such as `std_msgs/msg/String`.
    """

    def __init__(self, topic_type: str) -> None:
        self.topic_type = topic_type
