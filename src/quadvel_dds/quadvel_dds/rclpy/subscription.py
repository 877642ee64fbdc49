"""Subscriptions."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from enum import Enum
from typing import Any

from quadvel_dds import messages, wire
from quadvel_dds.errors import unsupported

from .logging import get_logger


class Subscription:
    class CallbackType(Enum):
        MessageOnly = 0
        WithMessageInfo = 1

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
        self._reader = subscription_impl
        self.msg_type = msg_type
        self.topic = topic
        self.callback = callback
        self.callback_group = callback_group
        self.qos_profile = qos_profile
        self.raw = raw

    @property
    def callback(self) -> Callable[..., Any]:
        return self._callback

    @callback.setter
    def callback(self, value: Callable[..., Any]) -> None:
        self._callback = value
        self._callback_type = callback_type(value)

    @property
    def topic_name(self) -> str:
        return self.topic

    def get_publisher_count(self) -> int:
        return self._reader.matched()

    def destroy(self) -> None:
        self._reader.close()

    handle = property(unsupported("Subscription.handle"))

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
        if self._callback_type == Subscription.CallbackType.MessageOnly:
            return lambda: self.callback(message)
        return lambda: self.callback(message, {"source_timestamp": info.source_timestamp})


def callback_type(callback: Callable[..., Any]) -> Subscription.CallbackType:
    """Whether a callback takes the message alone or its information too."""
    for number, type_ in (
        (1, Subscription.CallbackType.MessageOnly),
        (2, Subscription.CallbackType.WithMessageInfo),
    ):
        try:
            inspect.signature(callback).bind(*range(number))
            return type_
        except TypeError:
            continue
    raise RuntimeError(
        "Expected a callback that takes one argument (the message) or two (message and its information)"
    )
