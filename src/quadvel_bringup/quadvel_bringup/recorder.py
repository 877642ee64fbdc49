"""Hear topics, and hand each message on as it came, in CDR, to what keeps it: `recording_file`.

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

from .recording_file import LATCHED, Heard, Keeper

ANY_QOS = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Hears every publisher, a reliable one too; of the fastest topic it holds seconds, for where other work keeps us from writing."""
LATCHED_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
HIDDEN = ("/parameter_events", "/rosout")
BATCH = 0.05  # s
OTHERS = 4  # callbacks that may come between two of ours although messages wait


class Recorder:
    """Hands what the given node receives on some topics to `keeper`, until it is closed, which closes the keeper.

    Whatever serves the node raises OSError where the disk is full.
    """

    def __init__(self, node: Node, keeper: Keeper) -> None:
        self._node, self._keeper = node, keeper
        self._subscriptions: dict[str, Any] = {}
        self._unknown: set[str] = set()
        self.counts: Counter[str] = Counter()
        """Messages kept so far, by topic."""

    def record(self, topic: str, typename: str) -> None:
        """Record a topic of a type such as "geometry_msgs/msg/Twist". Raises ValueError if it is unknown."""
        if topic in self._subscriptions:
            return
        if typename not in STORE.fielddefs:
            raise ValueError(f"topic {topic} has the type '{typename}', whose definition is not known")
        package, kind, name = typename.split("/")
        self._subscriptions[topic] = self._node.create_subscription(
            getattr(import_module(f"{package}.{kind}"), name),
            topic,
            self._keeps(topic, typename),
            LATCHED_QOS if topic in LATCHED else ANY_QOS,
            raw=True,
        )

    def record_all(self, only: Iterable[str] = ()) -> None:
        """Record every topic that is there now, or those of `only`; to be called again as topics come."""
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
        """Let the executor of our node write for so long what comes.

        In real time it looks once in BATCH, for all that waits: waking for each message would take from the
        processes that are recorded several times what writing does. On simulated time, whose pace is not known,
        messages are written as they come, since they are filed under the time of writing.
        """
        pause = 0.0 if self._node.get_parameter("use_sim_time").value else BATCH
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            time.sleep(min(left, pause))
            executor.spin_once(timeout_sec=left)
            self.write_waiting(executor, until)

    def write_waiting(self, executor: Executor, until: float = math.inf) -> None:
        """Write all that waits now. Other callbacks of our node, such as that of /clock, take turns with ours.

        until: s on the monotonic clock, when to leave the rest for the next time: more may come than one can write.
        """
        in_vain = 0
        while in_vain < OTHERS and time.monotonic() < until:
            written = self.counts.total()
            executor.spin_once(timeout_sec=0.0)
            in_vain = 0 if self.counts.total() > written else in_vain + 1
        self._keeper.settle()

    def close(self, finish: bool = True) -> None:
        """Hear nothing any more, and close what keeps; finish: false where nothing can be written any more."""
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

    def _keeps(self, topic: str, typename: str) -> Callable[[bytes, dict[str, int]], None]:
        clock = self._node.get_clock()

        def keep(data: bytes, info: dict[str, int]) -> None:
            self._keeper.keep(Heard(topic, typename, clock.now().nanoseconds, info["source_timestamp"], data))
            self.counts[topic] += 1

        return keep
