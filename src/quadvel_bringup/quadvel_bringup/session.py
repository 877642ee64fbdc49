"""The node that a command of the operator has while it runs: it listens, calls services, and is gone.

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

from .nodes import enclave
from .whereabouts import whereabouts

PATIENCE = 4.0
"""s to find out whether somebody is there: on a busy machine discovery takes a second, and where Fast DDS has missed the first
announcements the next ones come 3 s later"""
ANSWER = 10.0
"""s within which a service answers that is there"""
AGAIN = 1.0
"""s after which an order without an answer is given again"""


class NobodyThere(ConnectionError):
    """Who should listen or answer is not running; the text says what to start."""


class Session:
    """A node and the executor that serves it. To be entered: outside of that they do not exist."""

    def __init__(self, name: str, rights: str = "operator") -> None:
        """rights: the SROS 2 enclave of the node `name`."""
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

    def nobody(self, text: str) -> NobodyThere:
        """The error that says so, and why that may be: messages of another type, another ROS domain."""
        return NobodyThere("; ".join([text, *map(str, all_conflicts(self.node)), whereabouts()]))

    def call(
        self,
        kind: Any,
        services: Sequence[str],
        absent: Callable[[], str],
        repeats: bool = True,
        **fields: Any,
    ) -> Any:
        """The response of the first of these services that is there.

        repeats: whether the order may be given again, which it is where no answer comes: one is lost where the server has not
        found us yet, although we have found it. Raises NobodyThere, with what `absent` says where no service is there.
        """
        clients = [self.node.create_client(kind, service) for service in services]
        if not self.spin_until(lambda: any(client.service_is_ready() for client in clients), PATIENCE):
            raise self.nobody(f"{' or '.join(services)}: nobody answers; {absent()}")
        client = next(client for client in clients if client.service_is_ready())
        asked: list[Any] = []
        for wait in repeat(AGAIN, round(ANSWER / AGAIN)) if repeats else (ANSWER,):
            asked.append(client.call_async(kind.Request(**fields)))
            if self.spin_until(lambda: any(future.done() for future in asked), wait):
                return next(future.result() for future in asked if future.done())
        raise NobodyThere(f"{client.service_name}: no answer within {ANSWER:g} s, though somebody offers it")
