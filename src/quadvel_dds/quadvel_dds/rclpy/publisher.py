"""Publishers of topics.

`messages` serializes, and `wire` writes to DDS.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from quadvel_dds import messages, wire
from quadvel_dds.errors import Partial


class Publisher(Partial):
    """Publisher of a topic, see rclpy's Publisher.

    Attributes:
        msg_type: Class of the messages.
        topic_name: Full name of the topic.
        qos_profile: QoS profile.
    """

    def __init__(
        self, publisher_impl: wire.Writer, msg_type: Any, topic: str, qos_profile: Any, event_callbacks: Any,
        callback_group: Any,
    ) -> None:  # fmt: skip
        self._writer: wire.Writer | None = publisher_impl
        self.msg_type = msg_type
        self.topic_name = topic
        self.qos_profile = qos_profile
        self._is_valid: Callable[[], bool] = lambda: True  # replaced by the `ok` of the node's context

    def publish(self, msg: Any) -> None:
        """Send a message.

        Args:
            msg: The message, or its CDR bytes.

        Raises:
            TypeError: The message has another type.
            RuntimeError: The publisher is destroyed, or the context is shut down.
        """
        if self._writer is None:
            raise RuntimeError(f"the publisher of '{self.topic_name}' was destroyed")
        if not self._is_valid():
            raise RuntimeError("Failed to publish: publisher's context is invalid")
        if isinstance(msg, self.msg_type):
            self._writer.write(messages.serialize(msg))
        elif isinstance(msg, bytes):
            self._writer.write(msg)
        else:
            raise TypeError(f"Expected {self.msg_type}, got {type(msg)}")

    def get_subscription_count(self) -> int:
        """Count the subscriptions that receive the messages.

        Returns:
            Number of subscriptions.
        """
        return self._writer.count() if self._writer else 0

    def destroy(self) -> None:
        """Delete the writer; `Node.destroy_publisher` calls this."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
