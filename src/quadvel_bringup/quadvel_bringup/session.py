"""A temporary node for an operator command: it subscribes and calls services.

Needs `rclpy`: ROS 2's own, or the embedded one after `quadvel_dds.install()`.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from itertools import repeat
from types import TracebackType
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from quadvel_nodes.topic_types import all_conflicts

from .discovery_hint import discovery_hint
from .nodes import enclave

DISCOVERY_TIMEOUT_S = 4.0
"""Time to discover a peer.

Discovery takes a second on a busy machine. If Fast DDS misses the first announcements, the next
ones come 3 s later.
"""
SERVICE_TIMEOUT_S = 10.0
"""Longest wait for the answer of an available service, retries included."""
SERVICE_RETRY_S = 1.0
"""Time after which an unanswered request is repeated."""


class NotRunningError(ConnectionError):
    """A required node does not run or does not answer; the message says what is missing."""


def not_running(node: Any, text: str) -> NotRunningError:
    """Return the error for a missing peer, with likely causes.

    Args:
        node: The node that misses it.
        text: What is missing.

    Returns:
        The error; it lists type conflicts first, and without one other ROS domains.
    """
    conflicts = [str(conflict) for conflict in all_conflicts(node)]
    return NotRunningError("; ".join([*conflicts, text] if conflicts else [text, discovery_hint()]))


class Session:
    """A node with an executor; both exist inside the `with` block only.

    Args:
        name: Name of the node.
        rights: Name of its SROS 2 enclave.

    Attributes:
        node: The node.
        executor: Its executor.
    """

    def __init__(self, name: str, rights: str = "operator") -> None:

        self._name, self._rights = name, rights

    def __enter__(self) -> Session:
        rclpy.init(
            args=["--ros-args", *enclave(self._rights)], signal_handler_options=SignalHandlerOptions.NO
        )
        self.node: Any = rclpy.create_node(self._name)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()

    def listen(self, kind: Any, topic: str, keep: int = 1) -> deque[Any]:
        """Subscribe to a topic.

        Args:
            kind: Message class.
            topic: The topic.
            keep: Number of messages to keep.

        Returns:
            The last `keep` messages, updated while the session spins.
        """
        heard: deque[Any] = deque(maxlen=keep)
        quality = QoSProfile(depth=min(keep, 100), reliability=ReliabilityPolicy.BEST_EFFORT)
        self.node.create_subscription(kind, topic, lambda message: heard.append(message), quality)
        return heard

    def spin_until(self, is_so: Callable[[], Any], seconds: float) -> bool:
        """Spin until a predicate holds.

        Args:
            is_so: The predicate.
            seconds: Timeout, s.

        Returns:
            Whether it held before the timeout.
        """
        until = time.monotonic() + seconds
        while not is_so():
            left = until - time.monotonic()
            if left <= 0.0:
                return False
            self.executor.spin_once(timeout_sec=min(left, 0.05))
        return True

    def spin(self, seconds: float) -> None:
        """Spin for a duration.

        Args:
            seconds: s.
        """
        self.spin_until(lambda: False, seconds)

    def call(
        self,
        kind: Any,
        services: Sequence[str],
        absent: Callable[[], str],
        may_retry: bool = True,
        **fields: Any,
    ) -> Any:
        """Call the first available one of several services.

        Args:
            kind: Service class.
            services: Names of services.
            absent: Returns advice if no service is available.
            may_retry: Whether the request may be sent again if no answer comes, because a repeated
                call does no harm. The first request is lost if the server has not discovered this
                client yet.
            fields: Fields of the request.

        Returns:
            The response.

        Raises:
            NotRunningError: No service is available, or it does not answer.
        """
        clients = [self.node.create_client(kind, service) for service in services]
        if not self.spin_until(
            lambda: any(client.service_is_ready() for client in clients), DISCOVERY_TIMEOUT_S
        ):
            raise not_running(self.node, f"{' or '.join(services)}: service not available; {absent()}")
        client = next(client for client in clients if client.service_is_ready())
        asked: list[Any] = []
        for wait in (
            repeat(SERVICE_RETRY_S, round(SERVICE_TIMEOUT_S / SERVICE_RETRY_S))
            if may_retry
            else (SERVICE_TIMEOUT_S,)
        ):
            asked.append(client.call_async(kind.Request(**fields)))
            if self.spin_until(lambda: any(future.done() for future in asked), wait):
                return next(future.result() for future in asked if future.done())
        raise NotRunningError(
            f"{client.service_name}: no answer within {SERVICE_TIMEOUT_S:g} s from its server"
        )
