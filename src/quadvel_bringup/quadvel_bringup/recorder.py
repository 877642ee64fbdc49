"""Record topics to an MCAP file that Foxglove and `ros2 bag` read. Messages are kept as they came, in CDR.

Needs `rclpy`: ROS 2's own, or the embedded one after `quadvel_dds.install()`.
"""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext, suppress
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.writer import CompressionType, Writer
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from quadvel_recordings.definitions import STORE

ANY_QOS = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Hears every publisher, a reliable one too; of the fastest topic it holds seconds, for where other work keeps us from writing."""
LATCHED_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATCHED = ("/tf_static", "/robot_description", "/ground")
"""Topics that are published once and kept for those who come later."""
HIDDEN = ("/parameter_events", "/rosout")
BATCH = 0.05  # s
CHUNK = 1.0
"""s, after which what was written so far goes to the disk: a recorder that is killed loses no more"""
OTHERS = 4  # callbacks that may come between two of ours although messages wait


class Recorder:
    """Writes what the given node receives on some topics until it is closed.

    The file has its index only then; where it never comes to that, `quadvel_recordings.reading` reads all but the last
    CHUNK. Writing raises OSError where the disk is full.
    """

    def __init__(self, node: Node, path: Path) -> None:
        self._node = node
        self._file = path.open("wb")
        self._writer = Writer(self._file, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library="quadvel")
        self._chunk_began = time.monotonic()
        self._disk = ThreadPoolExecutor(1, "disk")
        self._synced: Future[None] | None = None
        self._open = True
        self._schemas: dict[str, int] = {}
        self._subscriptions: dict[str, Any] = {}
        self._unknown: set[str] = set()
        self.counts: Counter[str] = Counter()
        """Messages written so far, by topic."""

    def record(self, topic: str, typename: str) -> None:
        """Record a topic of a type such as "geometry_msgs/msg/Twist". Raises ValueError if it is unknown."""
        if topic in self._subscriptions:
            return
        if typename not in STORE.fielddefs:
            raise ValueError(f"topic {topic} has the type '{typename}', whose definition is not known")
        package, kind, name = typename.split("/")
        # An empty list: rosbag2 wants the key, and its versions disagree about what stands in it.
        channel = self._writer.register_channel(
            topic, "cdr", self._schema(typename), {"offered_qos_profiles": "[]"}
        )
        self._subscriptions[topic] = self._node.create_subscription(
            getattr(import_module(f"{package}.{kind}"), name),
            topic,
            self._writes(topic, channel),
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
        if time.monotonic() - self._chunk_began > CHUNK:
            self._end_chunk()

    def _end_chunk(self) -> None:
        """Hand the chunk to the system, and have it brought to the disk beside us, as a disk may take its time."""
        self._chunk_began = time.monotonic()
        self._writer.flush()  # type: ignore[no-untyped-call]
        if self._synced is None or self._synced.done():
            self._synced = self._disk.submit(os.fdatasync, self._file.fileno())

    def close(self, finish: bool = True) -> None:
        """Finish the file, or leave it as it is where it cannot be written any more. A second call does nothing."""
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
        if self._open:
            self._open = False
            try:
                if finish:
                    self._writer.finish()  # type: ignore[no-untyped-call]
            finally:
                self._disk.shutdown()
                with nullcontext() if finish else suppress(OSError):
                    self._file.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(finish=not isinstance(error, OSError))

    def _schema(self, typename: str) -> int:
        if typename not in self._schemas:
            text, _ = STORE.generate_msgdef(typename, ros_version=2)
            self._schemas[typename] = self._writer.register_schema(typename, "ros2msg", text.encode())
        return self._schemas[typename]

    def _writes(self, topic: str, channel: int) -> Callable[[bytes, dict[str, int]], None]:
        clock = self._node.get_clock()

        def write(data: bytes, info: dict[str, int]) -> None:
            now = clock.now().nanoseconds
            sent = info["source_timestamp"]
            self._writer.add_message(channel, now, data, publish_time=sent, sequence=self.counts[topic])
            self.counts[topic] += 1

        return write
