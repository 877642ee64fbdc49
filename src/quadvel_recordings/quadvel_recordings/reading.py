"""Messages out of a recording: an MCAP file, a rosbag2 folder or its .db3. Writing is `quadvel_bringup.recorder`'s.

Definitions come from the recording or from `definitions`, so it is read where no ROS 2 is installed.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Reader

from .cut_off import is_cut_off, kept_messages, what_is_kept
from .recorded import is_known, read


class RecordingError(ValueError):
    """A recording that cannot be read; one sentence that names the file."""


def read_messages(
    path: Path, wanted: Callable[[str, str], bool], tell: Callable[[str], None] | None = None
) -> Iterator[tuple[str, int, Any]]:
    """Topic, time of arrival (ns) and message, in the order of arrival, where `wanted(topic, typename)`.

    Of an MCAP file whose recorder was killed come the messages that were written whole. One sentence that says so goes
    to `tell`, or becomes a warning. Raises RecordingError for what is no recording, and OSError where there is no such file.
    """
    for topic, time, message in unread_messages(path, wanted, tell):
        try:
            whole = message()
        except Exception as error:
            raise _broken(path, error) from error
        yield topic, time, whole


def unread_messages(
    path: Path, wanted: Callable[[str, str], bool], tell: Callable[[str], None] | None = None
) -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """The same where most messages are never looked at: in place of each message what reads it out of its bytes."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        raise RecordingError(f"{path}: the folder is no recording: a rosbag2 folder holds a metadata.yaml")
    if is_cut_off(path):
        yield from _kept(path, wanted, tell)
        return
    try:
        with Reader(path) as reader:
            chosen = [
                channel
                for channel in reader.connections
                if wanted(channel.topic, channel.msgtype) and is_known(channel.msgtype, channel.msgdef)
            ]
            # Without any chosen channel the reader would give all messages.
            for channel, time, data in reader.messages(chosen) if chosen else ():
                yield channel.topic, time, partial(read, data, channel.msgtype, channel.msgdef)
    except PermissionError:
        raise
    except Exception as error:  # a broken file fails anywhere in bag reader, decompression or deserialisation
        raise _broken(path, error) from error


def _broken(path: Path, error: Exception) -> RecordingError:
    what = " ".join(str(error).split()) or type(error).__name__
    return RecordingError(f"{path}: no whole recording, perhaps cut off: {what}")


def _kept(
    path: Path, wanted: Callable[[str, str], bool], tell: Callable[[str], None] | None
) -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """The same of a file that was cut off."""
    kept = what_is_kept(path)
    if not kept:
        raise RecordingError(f"{path}: the recording was cut off before anything of it was whole")
    text = f"recording: it was cut off; {kept} are kept"
    if tell is None:
        warnings.warn(f"{path}: {text}", stacklevel=3)
    else:
        tell(text)
    for one in kept_messages(path):
        if wanted(one.topic, one.typename) and is_known(one.typename, one.definition):
            yield one.topic, one.time, partial(read, one.data, one.typename, one.definition)
