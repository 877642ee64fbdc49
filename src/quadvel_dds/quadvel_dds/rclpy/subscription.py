"""Subscriptions."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from quadvel_dds import messages, wire
from quadvel_dds.errors import Partial

from .logging import get_logger


class Subscription(Partial):
    def __init__(
        self,
        subscription_impl: wire.Reader,
        msg_type: Any,
        topic: str,
        callback: Callable[..., Any],
        callback_group: Any,
        qos_profile: Any,
        raw: bool,
        event_callbacks: Any,
    ) -> None:
        """callback: takes the message, as bytes where `raw`, or the message and its information."""
        self._reader = subscription_impl
        self.msg_type = msg_type
        self.topic = topic
        self.callback = callback
        self.qos_profile = qos_profile
        self.raw = raw
        self._takes_information = _takes(callback, 2) and not _takes(callback, 1)
        if not self._takes_information and not _takes(callback, 1):
            raise RuntimeError(
                "Expected a callback that takes one argument (the message) or two (message and its information)"
            )

    @property
    def topic_name(self) -> str:
        return self.topic

    def get_publisher_count(self) -> int:
        return self._reader.count()

    def destroy(self) -> None:
        self._reader.close()

    def _take(self) -> Callable[[], Any] | None:
        """The oldest message that waits, as a call of the callback; a malformed one is logged and dropped."""
        sample = self._reader.take()
        if sample is None:
            return None
        data, info = sample
        try:
            message = data if self.raw else messages.deserialize(data, self.msg_type.TYPENAME)
        except ValueError as error:
            get_logger("rclpy").error(
                f"dropped a message on {self.topic}: {error}", throttle_duration_sec=1.0
            )
            return None
        if not self._takes_information:
            return lambda: self.callback(message)
        return lambda: self.callback(message, {"source_timestamp": info.source_timestamp})


def _takes(callback: Callable[..., Any], number: int) -> bool:
    """Whether a function can be called with so many arguments."""
    try:
        inspect.signature(callback).bind(*range(number))
    except TypeError:
        return False
    return True
