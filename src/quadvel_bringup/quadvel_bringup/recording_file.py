"""Storage of recorded messages, without ROS.

Messages go to an MCAP file for Foxglove and `ros2 bag`, or stay in memory until a fault.
"""

from __future__ import annotations

import os
import time
from collections import Counter, deque
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Protocol

import attrs
from mcap.writer import CompressionType, Writer

from quadvel_recordings.definitions import STORE

CHUNK_PERIOD_S = 1.0
"""Time after which written messages are flushed to disk.

A killed recorder loses at most that much.
"""
LATCHED = ("/tf_static", "/robot_description", "/ground")
"""Topics with transient-local durability."""


@attrs.frozen
class RawMessage:
    """A serialised message.

    Attributes:
        topic: Its topic.
        typename: Its type.
        time: When it was received, ns.
        sent: When it was sent, ns.
        data: The message in CDR.
    """

    topic: str
    typename: str
    time: int
    sent: int
    data: bytes


class MessageSink(Protocol):
    """Stores the messages of a recorder."""

    def keep(self, message: RawMessage) -> None:
        """Store a message.

        Args:
            message: A message of a type that `STORE` defines. OSError is raised if the disk is
                full.
        """

    def settle(self) -> None:
        """Do slow work; called between messages."""

    def close(self, finish: bool = True) -> None:
        """Finish; further calls have no effect.

        Args:
            finish: False if nothing can be written any more.
        """


class RecordingFile:
    """An MCAP file being written.

    The index is written by `close`. Without it `quadvel_recordings.reading` reads all but the last
    CHUNK_PERIOD_S.

    Args:
        path: The file to write.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("wb")
        self._writer = Writer(self._file, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library="quadvel")
        self._chunk_began = time.monotonic()
        self._disk = ThreadPoolExecutor(1, "disk")
        self._synced: Future[None] | None = None
        self._open = True
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: Counter[str] = Counter()

    def keep(self, message: RawMessage) -> None:
        """Write a message.

        Args:
            message: The message.
        """
        if message.topic not in self._channels:
            # An empty list: rosbag2 needs the key, but its versions disagree about its content.
            self._channels[message.topic] = self._writer.register_channel(
                message.topic, "cdr", self._schema(message.typename), {"offered_qos_profiles": "[]"}
            )
        self._writer.add_message(
            self._channels[message.topic],
            message.time,
            message.data,
            publish_time=message.sent,
            sequence=self._counts[message.topic],
        )
        self._counts[message.topic] += 1

    def _schema(self, typename: str) -> int:
        """Register a type and return its id."""
        if typename not in self._schemas:
            text, _ = STORE.generate_msgdef(typename, ros_version=2)
            self._schemas[typename] = self._writer.register_schema(typename, "ros2msg", text.encode())
        return self._schemas[typename]

    def settle(self) -> None:
        """Flush an old chunk and start its synchronisation in another thread: disks may be slow."""
        if time.monotonic() - self._chunk_began <= CHUNK_PERIOD_S:
            return
        self._chunk_began = time.monotonic()
        self._writer.flush()  # type: ignore[no-untyped-call]
        if self._synced is None or self._synced.done():
            self._synced = self._disk.submit(os.fdatasync, self._file.fileno())

    def close(self, finish: bool = True) -> None:
        """Write the index and close the file.

        Args:
            finish: False if nothing can be written any more.
        """
        if not self._open:
            return
        self._open = False
        try:
            if finish:
                self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._disk.shutdown()
            with nullcontext() if finish else suppress(OSError):
                self._file.close()


class RingBuffer:
    """Keeps the messages of the last seconds in memory, and the newest message of latched topics.

    Args:
        seconds: Duration, s.
    """

    def __init__(self, seconds: float) -> None:
        self._nanoseconds = round(1e9 * seconds)
        self._messages: deque[RawMessage] = deque()
        self._latched: dict[str, RawMessage] = {}

    def keep(self, message: RawMessage) -> None:
        """Store a message and drop expired ones.

        Args:
            message: The message.
        """
        if message.topic in LATCHED:
            self._latched[message.topic] = message
            return
        self._messages.append(message)
        while message.time - self._messages[0].time > self._nanoseconds:
            self._messages.popleft()

    def settle(self) -> None:
        """Do nothing: there is no slow work."""

    def close(self, finish: bool = True) -> None:
        """Do nothing: there is no open file.

        Args:
            finish: Ignored.
        """

    def save(self, path: Path) -> int:
        """Write all stored messages to an MCAP file. OSError passes through.

        Args:
            path: The file to write.

        Returns:
            Number of messages.
        """
        kept = [*self._latched.values(), *self._messages]
        file = RecordingFile(path)
        try:
            for message in kept:
                file.keep(message)
        except OSError:
            file.close(finish=False)
            raise
        file.close()
        return len(kept)
