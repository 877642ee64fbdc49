"""The node that a command of the operator has while it runs: it listens, calls services, and is gone.

Needs `rclpy`: ROS 2's own, or the embedded one after `quadvel_dds.install()`.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

PATIENCE = 3.0
"""s to find out whether somebody is there: discovery takes a second on a busy machine"""
ANSWER = 10.0
"""s within which a service answers that is there"""


class NobodyThere(ConnectionError):
    """Who should listen or answer is not running; the text says what to start."""


class Session:
    """A node and the executor that serves it. To be entered: outside of that they do not exist."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> Session:
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
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
        """The last `keep` messages of a topic, as they come while this session spins."""
        heard: deque[Any] = deque(maxlen=keep)
        quality = QoSProfile(depth=min(keep, 100), reliability=ReliabilityPolicy.BEST_EFFORT)
        self.node.create_subscription(kind, topic, lambda message: heard.append(message), quality)
        return heard

    def spin_until(self, is_so: Callable[[], Any], seconds: float) -> bool:
        """Serve until the predicate holds; whether it does before the time (s) is up."""
        until = time.monotonic() + seconds
        while not is_so():
            left = until - time.monotonic()
            if left <= 0.0:
                return False
            self.executor.spin_once(timeout_sec=min(left, 0.05))
        return True

    def spin(self, seconds: float) -> None:
        """Serve for so long (s)."""
        self.spin_until(lambda: False, seconds)

    def call(self, kind: Any, service: str, serves: str, **fields: Any) -> Any:
        """The response of a service. Raises NobodyThere with `serves`, what should be running, where none comes."""
        client = self.node.create_client(kind, service)
        if not self.spin_until(client.service_is_ready, PATIENCE):
            raise NobodyThere(f"{service}: nobody answers; {serves}")
        future = client.call_async(kind.Request(**fields))
        if not self.spin_until(future.done, ANSWER):
            raise NobodyThere(f"{service}: no answer within {ANSWER:g} s; {serves}")
        return future.result()
