"""What a recorder hears, kept: in an MCAP file that Foxglove and `ros2 bag` read, or in memory until a fault. No ROS."""

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

CHUNK = 1.0
"""s, after which what was written so far goes to the disk: a recorder that is killed loses no more"""
LATCHED = ("/tf_static", "/robot_description", "/ground")
"""Topics that are published once and kept for those who come later."""


@attrs.frozen
class Heard:
    """A message in CDR as it came: its topic and type, ns when it was taken up and when it was sent."""

    topic: str
    typename: str
    time: int
    sent: int
    data: bytes


class Keeper(Protocol):
    """Takes what a recorder hears."""

    def keep(self, message: Heard) -> None:
        """Keep a message, of a type that `STORE` defines. Raises OSError where the disk is full."""

    def settle(self) -> None:
        """Called between messages: time for what takes longer."""

    def close(self, finish: bool = True) -> None:
        """Finish, or leave all as it is where nothing can be written any more. A second call does nothing."""


class RecordingFile:
    """An MCAP file under way. It has its index only when it is closed; where it never comes to that,
    `quadvel_recordings.reading` reads all but the last CHUNK.
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

    def keep(self, message: Heard) -> None:
        """Write a message."""
        if message.topic not in self._channels:
            # An empty list: rosbag2 wants the key, and its versions disagree about what stands in it.
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
        if typename not in self._schemas:
            text, _ = STORE.generate_msgdef(typename, ros_version=2)
            self._schemas[typename] = self._writer.register_schema(typename, "ros2msg", text.encode())
        return self._schemas[typename]

    def settle(self) -> None:
        """Hand the chunk to the system once it is old, and have it brought to the disk beside us, as a disk may take its time."""
        if time.monotonic() - self._chunk_began <= CHUNK:
            return
        self._chunk_began = time.monotonic()
        self._writer.flush()  # type: ignore[no-untyped-call]
        if self._synced is None or self._synced.done():
            self._synced = self._disk.submit(os.fdatasync, self._file.fileno())

    def close(self, finish: bool = True) -> None:
        """Finish the file."""
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


class Ring:
    """The messages of the last `seconds`, in memory, and the newest of what is published only once."""

    def __init__(self, seconds: float) -> None:
        self._nanoseconds = round(1e9 * seconds)
        self._messages: deque[Heard] = deque()
        self._latched: dict[str, Heard] = {}

    def keep(self, message: Heard) -> None:
        """Keep a message, and forget those that are too old."""
        if message.topic in LATCHED:
            self._latched[message.topic] = message
            return
        self._messages.append(message)
        while message.time - self._messages[0].time > self._nanoseconds:
            self._messages.popleft()

    def settle(self) -> None:
        """Nothing takes longer."""

    def close(self, finish: bool = True) -> None:
        """Nothing is left open."""

    def save(self, path: Path) -> int:
        """Write all that is kept, as a recording; how many messages it is. Raises OSError."""
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
