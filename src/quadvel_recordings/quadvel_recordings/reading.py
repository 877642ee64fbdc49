"""Messages out of a recording: an MCAP file, a rosbag2 folder or its .db3, a bag of ROS 1. Writing is `quadvel_bringup.recorder`'s.

Definitions come from the recording or from `definitions`, so it is read where no ROS 2 is installed.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1.reader import decompressors
from rosbags.rosbag2 import Reader

from .bounds import TooLargeError, check_chunks, check_packed_file, unpacked
from .cut_off import is_cut_off, kept_messages, what_is_kept
from .recorded import is_known, read

STORAGES = {".mcap": "mcap", ".db3": "sqlite3"}
"""What metadata.yaml calls the files of a rosbag2, by their suffix."""


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
    for part in _parts(path, tell):
        if part.suffix == ".mcap":
            _check(part, partial(check_chunks, part))
        if is_cut_off(part):
            yield from _kept(part, wanted, tell)
        elif part.suffix == ".bag":
            yield from _of_ros1(part, wanted)
        else:
            yield from _of_ros2(part, wanted)


def topics(path: Path) -> dict[str, str]:
    """All topics of a recording, each with its type. Raises as `read_messages` does."""
    found: dict[str, str] = {}

    def look(topic: str, typename: str) -> bool:
        found[topic] = typename
        return False

    for _ in unread_messages(path, look, lambda _: None):
        pass
    return found


def _parts(path: Path, tell: Callable[[str], None] | None) -> Sequence[Path]:
    """The recording itself, or the files in a folder whose metadata.yaml is missing or does not name their kind."""
    if not path.is_dir():
        return [path]
    files = sorted((one for one in path.iterdir() if one.suffix in STORAGES), key=_number)
    metadata = path / "metadata.yaml"
    if not metadata.exists():
        if not files:
            raise RecordingError(
                f"{path}: the folder is no recording: a rosbag2 folder holds a metadata.yaml"
            )
        reason = "metadata.yaml is missing"
    else:
        kind = re.search(
            r"^\s*storage_identifier:\s*(.*?)\s*$", metadata.read_text(errors="replace"), re.MULTILINE
        )
        name = "mcap" if kind is None else kind[1].strip("\"'")
        if not files or name in STORAGES.values():
            return [path]
        reason = f"metadata.yaml: storage_identifier is '{name}', expected mcap or sqlite3"
    _say(path, f"recording: {reason}; read from {', '.join(one.name for one in files)}", tell)
    return files


def _number(path: Path) -> tuple[int, str]:
    """Recorders number the files of a long recording: name_0, name_1, ..., name_10."""
    number = re.search(r"_(\d+)$", path.stem)
    return (int(number[1]) if number else -1), path.name


def _say(path: Path, text: str, tell: Callable[[str], None] | None) -> None:
    if tell is None:
        warnings.warn(f"{path}: {text}", stacklevel=5)
    else:
        tell(text)


def _check(path: Path, check: Callable[[], None]) -> None:
    try:
        check()
    except TooLargeError as error:
        raise RecordingError(f"{path}: {error}") from None


def _of_ros2(path: Path, wanted: Callable[[str, str], bool]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """Out of a rosbag2 folder or one of its files."""
    if path.is_dir():
        for packed in sorted(path.glob("*.zstd")):
            _check(path, partial(check_packed_file, packed))
        for chunked in sorted(path.glob("*.mcap")):
            _check(path, partial(check_chunks, chunked))
    try:
        with Reader(path) as reader:
            chosen = _chosen(reader.connections, wanted)
            packed_messages = reader.compression_mode == "message"
            if packed_messages:
                _check_messages(reader, chosen)
            # Without any chosen channel the reader would give all messages.
            for channel, time, data in reader.messages(chosen) if chosen else ():
                yield channel.topic, time, partial(read, data, channel.msgtype, channel.msgdef)
    except TooLargeError as error:
        raise RecordingError(f"{path}: {error}") from None
    except PermissionError:
        raise
    except Exception as error:  # a broken file fails anywhere in bag reader, decompression or deserialisation
        raise _broken(path, error) from error


def _check_messages(reader: Reader, chosen: Collection[Connection]) -> None:
    """Raises TooLargeError where a message that was packed on its own is too large."""
    topics = {channel.topic for channel in chosen}
    for storage in getattr(reader.storage, "storages", ()):
        channels = [channel for channel in storage.connections if channel.topic in topics]
        for _, _, data in storage.messages(channels) if channels else ():
            unpacked(data, "zstd")


def _of_ros1(path: Path, wanted: Callable[[str, str], bool]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """Out of a bag of ROS 1, whose chunks are unpacked no further than they may."""
    try:
        with Ros1Reader(path) as reader:
            for position, chunk in reader.chunks.items():
                packing = next(
                    (name for name in ("bz2", "lz4") if chunk.decompressor is decompressors[name]), None
                )
                if packing:
                    bounded = partial(unpacked, compression=packing)
                    reader.chunks[position] = chunk._replace(decompressor=bounded)
            chosen = _chosen(reader.connections, wanted)
            for channel, time, data in reader.messages(chosen) if chosen else ():
                yield channel.topic, time, partial(read, data, channel.msgtype, channel.msgdef, ros1=True)
    except TooLargeError as error:
        raise RecordingError(f"{path}: {error}") from None
    except PermissionError:
        raise
    except Exception as error:  # as above
        raise _broken(path, error) from error


def _chosen(channels: Collection[Connection], wanted: Callable[[str, str], bool]) -> list[Connection]:
    """Those that are wanted, of a type that is known."""
    return [one for one in channels if wanted(one.topic, one.msgtype) and is_known(one.msgtype, one.msgdef)]


def _broken(path: Path, error: Exception) -> RecordingError:
    what = " ".join(str(error).split()) or type(error).__name__
    return RecordingError(f"{path}: no whole recording: {what}")


def _kept(
    path: Path, wanted: Callable[[str, str], bool], tell: Callable[[str], None] | None
) -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """The same of a file that was cut off."""
    kept = what_is_kept(path)
    if not kept:
        raise RecordingError(f"{path}: the recording was cut off before anything of it was whole")
    text = f"recording: it was cut off; {kept} are kept"
    _say(path, text, tell)
    for one in kept_messages(path):
        if wanted(one.topic, one.typename) and is_known(one.typename, one.definition):
            yield one.topic, one.time, partial(read, one.data, one.typename, one.definition)
