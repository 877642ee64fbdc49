"""Messages out of a recording: an MCAP file, a rosbag2 folder or its .db3. Writing is `quadvel_bringup.recorder`'s.

Definitions come from `definitions`, so a recording is read where no ROS 2 is installed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Reader

from .definitions import STORE


class RecordingError(ValueError):
    """A recording that cannot be read; one sentence that names the file."""


def read_messages(path: Path, wanted: Callable[[str, str], bool]) -> Iterator[tuple[str, int, Any]]:
    """Topic, time of arrival (ns) and message, in the order of arrival, where `wanted(topic, typename)`.

    Raises RecordingError for what is no whole recording, and OSError where there is no such file.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    try:
        with Reader(path) as reader:
            chosen = [
                channel
                for channel in reader.connections
                if wanted(channel.topic, channel.msgtype) and channel.msgtype in STORE.fielddefs
            ]
            # Without any chosen channel the reader would give all messages.
            for channel, time, data in reader.messages(chosen) if chosen else ():
                yield channel.topic, time, STORE.deserialize_cdr(data, channel.msgtype)
    except PermissionError:
        raise
    except Exception as error:  # a broken file fails anywhere in bag reader, decompression or deserialisation
        what = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(f"{path}: no whole recording, perhaps cut off: {what}") from error
