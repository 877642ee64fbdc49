"""Recorder of topics: passes serialised messages to a `MessageSink` of `recording_file`.

Needs `rclpy`: ROS 2's own, or the embedded one after `quadvel_dds.install()`.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable
from importlib import import_module
from types import TracebackType
from typing import Any

from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from quadvel_recordings.definitions import STORE

from .recording_file import LATCHED, MessageSink, RawMessage

ANY_QOS = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Compatible with all publishers; the depth bridges seconds of the fastest topic."""
LATCHED_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
HIDDEN = ("/parameter_events", "/rosout")
BATCH_PERIOD_S = 0.05
"""Time between two batches of messages."""
MAX_OTHER_CALLBACKS = 4
"""Number of other callbacks that may precede a waiting message."""


class Recorder:
    """Passes received messages to a sink.

    Closing it closes the sink. If the disk is full, spinning the executor raises OSError.

    Args:
        node: The node that subscribes.
        keeper: The sink.

    Attributes:
        counts: Number of messages by topic.
    """

    def __init__(self, node: Node, keeper: MessageSink) -> None:
        self._node, self._keeper = node, keeper
        self._subscriptions: dict[str, Any] = {}
        self._unknown: set[str] = set()
        self.counts: Counter[str] = Counter()

    def record(self, topic: str, typename: str) -> None:
        """Record a topic.

        Args:
            topic: The topic.
            typename: Its type, such as "geometry_msgs/msg/Twist".

        Raises:
            ValueError: The type is unknown.
        """
        if topic in self._subscriptions:
            return
        if typename not in STORE.fielddefs:
            raise ValueError(f"topic {topic} has the type '{typename}', whose definition is unknown")
        package, kind, name = typename.split("/")
        self._subscriptions[topic] = self._node.create_subscription(
            getattr(import_module(f"{package}.{kind}"), name),
            topic,
            self._callback(topic, typename),
            LATCHED_QOS if topic in LATCHED else ANY_QOS,
            raw=True,
        )

    def record_all(self, only: Iterable[str] = ()) -> None:
        """Record all present topics; call it again to include new ones.

        Args:
            only: Restricts it to these topics, if not empty.
        """
        wanted = set(only)
        for topic, typenames in self._node.get_topic_names_and_types():
            if topic in self._unknown or (topic not in wanted if wanted else topic in HIDDEN):
                continue
            try:
                self.record(topic, typenames[0])
            except ValueError as error:
                self._unknown.add(topic)
                self._node.get_logger().warning(f"not recorded: {error}")

    def serve(self, executor: Executor, seconds: float) -> None:
        """Spin the executor of the node and write messages for a duration.

        In real time it wakes once per BATCH_PERIOD_S: waking for each message would take several
        times more CPU time from the recorded processes than writing. In simulated time it writes at
        once, because messages are stamped when they are written.

        Args:
            executor: Executor of the node.
            seconds: Duration, s.
        """
        pause = 0.0 if self._node.get_parameter("use_sim_time").value else BATCH_PERIOD_S
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            time.sleep(min(left, pause))
            executor.spin_once(timeout_sec=left)
            self.write_waiting(executor, until)

    def write_waiting(self, executor: Executor, until: float = math.inf) -> None:
        """Write all waiting messages.

        The executor may run other callbacks of the node, such as that of /clock, in between. If
        MAX_OTHER_CALLBACKS in a row bring no message, none is waiting.

        Args:
            executor: Executor of the node.
            until: Latest end on the monotonic clock, s; the rest stays for the next call.
        """
        without_message = 0
        while without_message < MAX_OTHER_CALLBACKS and time.monotonic() < until:
            written = self.counts.total()
            executor.spin_once(timeout_sec=0.0)
            without_message = 0 if self.counts.total() > written else without_message + 1
        self._keeper.settle()

    def close(self, finish: bool = True) -> None:
        """Unsubscribe and close the sink.

        Args:
            finish: False if nothing can be written any more.
        """
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
        self._keeper.close(finish)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(finish=not isinstance(error, OSError))

    def _callback(self, topic: str, typename: str) -> Callable[[bytes, dict[str, int]], None]:
        """Return the callback of a topic."""
        clock = self._node.get_clock()

        def keep(data: bytes, info: dict[str, int]) -> None:
            self._keeper.keep(
                RawMessage(topic, typename, clock.now().nanoseconds, info["source_timestamp"], data)
            )
            self.counts[topic] += 1

        return keep
