"""Subscriptions of topics.

`wire` reads from DDS, `messages` deserializes, and the executor runs the callback.
"""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature
from typing import Any

from quadvel_dds import messages, wire
from quadvel_dds.errors import Partial

from .logging import get_logger


class Subscription(Partial):
    """Subscription of a topic, see rclpy's Subscription.

    Attributes:
        msg_type: Class of the messages.
        topic_name: Full name of the topic.
        callback: Called with each message, and its information if it takes two arguments.
        qos_profile: QoS profile.
        raw: Whether the callback gets CDR bytes.
    """

    def __init__(
        self, subscription_impl: wire.Reader, msg_type: Any, topic: str, callback: Callable[..., Any],
        callback_group: Any, qos_profile: Any, raw: bool, event_callbacks: Any,
    ) -> None:  # fmt: skip
        """Create a subscription; `Node.create_subscription` calls this.

        Args:
            subscription_impl: DDS reader.
            msg_type: Class of the messages.
            topic: Full name of the topic.
            callback: Called with each message, and its information if it takes two arguments.
            callback_group: Ignored.
            qos_profile: QoS profile.
            raw: Whether the callback gets CDR bytes.
            event_callbacks: Ignored.
        """
        self._reader = subscription_impl
        self.msg_type = msg_type
        self.topic_name = topic
        self.callback = callback
        self.qos_profile = qos_profile
        self.raw = raw
        self._takes_information = not _takes_one(callback)

    def get_publisher_count(self) -> int:
        """Count the publishers that are received.

        Returns:
            Number of publishers.
        """
        return self._reader.count()

    def destroy(self) -> None:
        """Delete the reader; `Node.destroy_subscription` calls this."""
        self._reader.close()

    def _take(self) -> Callable[[], Any] | None:
        """Return a call of the callback with the oldest message, or None; drop malformed ones."""
        sample = self._reader.take()
        if sample is None:
            return None
        try:
            message = sample[0] if self.raw else messages.deserialize(sample[0], self.msg_type.TYPENAME)
        except ValueError as error:
            text = f"dropped a message on {self.topic_name}: {error}"
            get_logger("rclpy").error(text, throttle_duration_sec=1.0)
            return None
        if not self._takes_information:
            return lambda: self.callback(message)
        return lambda: self.callback(message, {"source_timestamp": sample[1].source_timestamp})


def _takes_one(callback: Callable[..., Any]) -> bool:
    """Return whether a callback accepts one argument."""
    try:
        signature(callback).bind(None)
    except TypeError:
        return False
    return True
