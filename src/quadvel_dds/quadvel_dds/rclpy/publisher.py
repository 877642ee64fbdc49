"""Publishers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from quadvel_dds import messages, wire
from quadvel_dds.errors import unsupported

from .duration import Duration
from .exceptions import InvalidHandle

FOREVER = Duration(nanoseconds=-(10**9))


class Publisher:
    def __init__(
        self,
        publisher_impl: wire.Writer,
        msg_type: Any,
        topic: str,
        qos_profile: Any,
        event_callbacks: Any,
        callback_group: Any,
    ) -> None:
        self._writer: wire.Writer | None = publisher_impl
        self.msg_type = msg_type
        self.topic = topic
        self.qos_profile = qos_profile
        self._is_valid: Callable[[], bool] = lambda: True  # the node tells whether its context still runs

    def publish(self, msg: Any) -> None:
        """Send a message, or its ready CDR bytes.

        Raises TypeError on a message of another type, ValueError on one that cannot be sent, RuntimeError
        after shutdown, InvalidHandle after `destroy`.
        """
        if self._writer is None:
            raise InvalidHandle(f"the publisher of '{self.topic}' was destroyed")
        if not self._is_valid():
            raise RuntimeError("Failed to publish: publisher's context is invalid")
        if isinstance(msg, self.msg_type):
            self._writer.write(messages.serialize(msg))
        elif isinstance(msg, bytes):
            self._writer.write(bytearray(msg))
        else:
            raise TypeError(f"Expected {self.msg_type}, got {type(msg)}")

    def get_subscription_count(self) -> int:
        return self._writer.matched() if self._writer else 0

    @property
    def topic_name(self) -> str:
        return self.topic

    def wait_for_all_acked(self, timeout: Duration = FOREVER) -> bool:
        """Wait until all matched reliable readers have all messages (for ever if the timeout is negative)."""
        if self._writer is None:
            raise InvalidHandle(f"the publisher of '{self.topic}' was destroyed")
        return self._writer.wait_for_acks(timeout.nanoseconds if timeout.nanoseconds >= 0 else 2**63 - 1)

    def destroy(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    assert_liveliness = unsupported("Publisher.assert_liveliness")
    handle = property(unsupported("Publisher.handle"))
