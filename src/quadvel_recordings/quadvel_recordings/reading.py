"""Reading of messages from MCAP files, rosbag2 folders and .db3 files, and ROS 1 bags.

Definitions come from the recording or from `definitions`, so no ROS 2 installation is needed.
`quadvel_bringup.recorder` writes recordings.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, MessageDefinition
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1.reader import decompressors
from rosbags.rosbag2 import Reader

from .bounds import TooLargeError, check_chunks, check_packed_file, decompress
from .recorded import deserialize, is_known
from .truncated import is_truncated, recover_messages, recovery_summary

STORAGES = {".mcap": "mcap", ".db3": "sqlite3"}
"""Storage identifiers of metadata.yaml by suffix of the file."""
SUFFIXES = (*STORAGES, ".bag")
"""Suffixes of recordings of ROS 2 and ROS 1."""
MAGIC = {b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
"""Suffixes by first bytes of the file; these count more than its name."""
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""First bytes of a compressed message; a serialised one begins with 0."""
METADATA_KEYS = {
    "version": r"\d",
    "topics_with_message_count": r"[-\[]",
    "relative_file_paths": r"(- *\S|\[)",
}
"""Keys without which metadata.yaml is of no use, and how their values begin."""

MAX_NAMES = 5
"""Most files that a message names; the others are counted."""
DESCRIPTION_TOPIC = "/robot_description"
"""Topic of the robot's URDF, by which a recording names its robot."""


class RecordingError(ValueError):
    """A recording is unreadable; the sentence names the file."""


def read_messages(
    path: Path, wanted: Callable[[str, str], bool], notify: Callable[[str], None] | None = None
) -> Iterator[tuple[str, int, Any]]:
    """Yield the messages of selected topics in the order of arrival.

    If the recorder of an MCAP file was killed, the complete messages are read.

    Args:
        path: An MCAP file, a rosbag2 folder, a .db3 file or a ROS 1 bag.
        wanted: Predicate of topic and type name that selects topics.
        notify: Receives a sentence if the recording is incomplete; by default it becomes a warning.

    Yields:
        Topic, time of arrival (ns) and message.

    Raises:
        RecordingError: The path is not a readable recording. OSError for a missing file passes
            through.
    """
    for topic, time, message in lazy_messages(path, wanted, notify):
        try:
            whole = message()
        except Exception as error:
            raise _unreadable(path, error) from error
        yield topic, time, whole


def lazy_messages(
    path: Path, wanted: Callable[[str, str], bool], notify: Callable[[str], None] | None = None
) -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """Yield messages as `read_messages` does, but deserialise each one only on demand.

    Args:
        path: As for `read_messages`.
        wanted: As for `read_messages`.
        notify: As for `read_messages`.

    Yields:
        Topic, time of arrival (ns) and a function that deserialises and returns the message.

    Raises:
        FileNotFoundError: There is no such file.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    for part in _recording_files(path, notify):
        if part.is_file():
            _check_bounds(part, partial(check_chunks, part))
        if is_truncated(part):
            yield from _recovered_messages(part, wanted, notify)
        elif part.suffix == ".bag":
            yield from _ros1_messages(part, wanted)
        else:
            yield from _ros2_messages(part, wanted)


def topics(path: Path) -> dict[str, str]:
    """List the topics of a recording.

    Args:
        path: As for `read_messages`; it raises the same errors.

    Returns:
        The type name of each topic.
    """
    found: dict[str, str] = {}

    def look(topic: str, typename: str) -> bool:
        """Note topic and type, and read no message."""
        found[topic] = typename
        return False

    for _ in lazy_messages(path, look, lambda _: None):
        pass
    return found


def recorded_description(path: Path) -> str:
    """Read the URDF of the robot from the topic `robot_description`.

    Args:
        path: As for `read_messages`; it raises the same errors.

    Returns:
        The XML, "" if none was recorded.
    """
    described = lazy_messages(
        path,
        lambda topic, kind: topic.endswith(DESCRIPTION_TOPIC) and kind == "std_msgs/msg/String",
        lambda _: None,
    )
    for _, _, message in described:
        return str(message().data)
    return ""


def _recording_files(path: Path, notify: Callable[[str], None] | None) -> Sequence[Path]:
    """Return the recording, or its files if metadata.yaml is missing or does not describe them."""
    if not path.is_dir():
        if path.suffix == ".zstd":
            raise RecordingError(f"{path}: {_unpack_advice(path)}")
        if _storage_suffix(path) not in SUFFIXES:
            expected = f"{', '.join(SUFFIXES)} or a folder of rosbag2"
            raise RecordingError(f"{path}: the suffix is '{path.suffix}', expected {expected}")
        return [path]
    files = _data_files(path)
    metadata = path / "metadata.yaml"
    reason = _metadata_fault(metadata, files) if metadata.exists() else "metadata.yaml is missing"
    if not reason:
        return [path]
    if len({_file_order(one)[1] for one in files}) > 1:
        raise RecordingError(
            f"{path}: the folder has several recordings: {_some_names(files)}; name one of them"
        )
    if files:
        _report(path, f"recording: {reason}; read from {', '.join(one.name for one in files)}", notify)
        return files
    if packed := sorted(path.glob("*.zstd")):
        raise RecordingError(f"{path}: {reason}; {_unpack_advice(packed[0])}")
    if metadata.exists():
        raise RecordingError(f"{path}: not a complete recording: {reason}")
    raise RecordingError(f"{path}: the folder is no recording: a rosbag2 folder holds a metadata.yaml")


def _data_files(folder: Path) -> list[Path]:
    """Return the files of a recording that are not compressed, in the order of time."""
    return sorted((one for one in folder.iterdir() if one.suffix in STORAGES), key=_file_order)


def _unpack_advice(packed: Path) -> str:
    """Return the command that decompresses a file."""
    return f"{packed.name} is compressed; unpack it: zstd -d {packed.name} -o {packed.stem}"


def _metadata_fault(metadata: Path, files: Sequence[Path]) -> str:
    """Return how metadata.yaml is incomplete or contradicts the files; "" if it does neither."""
    text = metadata.read_text(errors="replace")
    for key, value in METADATA_KEYS.items():
        if not re.search(rf"^[ \t]*{key}:\s*{value}", text, re.MULTILINE):
            return f"metadata.yaml is {'cut off' if text.strip() else 'empty'}: {key} is missing"
    if not re.search(r"[:-] [^\n]*\S\s*\Z", text):
        return "metadata.yaml is cut off: its last line is incomplete"
    found = re.search(r"^[ \t]*storage_identifier:[ \t]*(.*?)[ \t\r]*$", text, re.MULTILINE)
    name = found[1].strip("\"'") if found else ""
    expected = {STORAGES[_storage_suffix(one)] for one in files if one.is_file() and one.name in text}
    if files and not expected:
        return "metadata.yaml names none of the files"
    if not files or name in expected:
        return ""
    return f"metadata.yaml: storage_identifier is '{name}', expected {' or '.join(sorted(expected))}"


def _storage_suffix(path: Path) -> str:
    """Return the suffix that fits the first bytes of a file, else its own."""
    with path.open("rb") as file:
        begin = file.read(max(map(len, MAGIC)))
    return next((suffix for magic, suffix in MAGIC.items() if begin.startswith(magic)), path.suffix)


def _some_names(files: Sequence[Path]) -> str:
    """Return the names of the first files."""
    names = ", ".join(one.name for one in files[:MAX_NAMES])
    return names if len(files) <= MAX_NAMES else f"{names} and {len(files) - MAX_NAMES} more"


def _file_order(path: Path) -> tuple[int, str]:
    """Return number and name without it, to sort the files of a split recording: name_0, ..., name_10."""
    number = re.search(r"_(\d+)$", path.stem)
    return (int(number[1]) if number else -1), path.stem[: number.start()] if number else path.stem


def _report(path: Path, text: str, notify: Callable[[str], None] | None) -> None:
    """Pass a sentence about a recording to the callback, or issue a warning."""
    if notify is None:
        warnings.warn(f"{path}: {text}", stacklevel=5)
    else:
        notify(text)


def _check_bounds(path: Path, check: Callable[[], None]) -> None:
    """Run a size check and add the name of the file to its error."""
    try:
        check()
    except TooLargeError as error:
        raise RecordingError(f"{path}: {error}") from None


def _ros2_messages(
    path: Path, wanted: Callable[[str, str], bool]
) -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """Yield messages of a rosbag2 folder or of one of its files."""
    if path.is_dir():
        for packed in sorted(path.glob("*.zstd")):
            _check_bounds(path, partial(check_packed_file, packed))
        for chunked in _data_files(path):
            _check_bounds(path, partial(check_chunks, chunked))
    try:
        with _reader(path) as reader:
            chosen = _select_connections(reader.connections, wanted)
            packed_messages = reader.compression_mode == "message"
            if packed_messages:
                _check_messages(reader, chosen)
            # With an empty selection the reader would return all messages.
            for channel, time, data in reader.messages(chosen) if chosen else ():
                yield channel.topic, time, partial(_deserialize, data, channel.msgtype, channel.msgdef)
    except TooLargeError as error:
        raise RecordingError(f"{path}: {error}") from None
    except PermissionError:
        raise
    except Exception as error:  # a broken file fails anywhere in bag reader, decompression or deserialisation
        raise _unreadable(path, error) from error


def _reader(path: Path) -> Reader:
    """Return the reader of a folder, or of the storage that a file holds whatever its suffix is."""
    reader = Reader(path)
    if path.is_file():
        reader.storage = Reader.STORAGE_PLUGINS[_storage_suffix(path)](path)
    return reader


def _deserialize(data: bytes, typename: str, definition: MessageDefinition) -> Any:
    """Deserialise a message, which may be compressed by itself even if no metadata.yaml states so."""
    whole = decompress(data, "zstd") if data[:4] == ZSTD_MAGIC else data
    return deserialize(whole, typename, definition)


def _check_messages(reader: Reader, chosen: Collection[Connection]) -> None:
    """Raise TooLargeError if an individually compressed message is too large."""
    topics = {channel.topic for channel in chosen}
    for storage in getattr(reader.storage, "storages", ()):
        channels = [channel for channel in storage.connections if channel.topic in topics]
        for _, _, data in storage.messages(channels) if channels else ():
            decompress(data, "zstd")


def _ros1_messages(
    path: Path, wanted: Callable[[str, str], bool]
) -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """Yield messages of a ROS 1 bag, with bounded decompression of its chunks."""
    try:
        with Ros1Reader(path) as reader:
            for position, chunk in reader.chunks.items():
                packing = next(
                    (name for name in ("bz2", "lz4") if chunk.decompressor is decompressors[name]), None
                )
                if packing:
                    bounded = partial(decompress, compression=packing)
                    reader.chunks[position] = chunk._replace(decompressor=bounded)
            chosen = _select_connections(reader.connections, wanted)
            for channel, time, data in reader.messages(chosen) if chosen else ():
                yield (
                    channel.topic,
                    time,
                    partial(deserialize, data, channel.msgtype, channel.msgdef, ros1=True),
                )
    except TooLargeError as error:
        raise RecordingError(f"{path}: {error}") from None
    except PermissionError:
        raise
    except Exception as error:  # as above
        raise _unreadable(path, error) from error


def _select_connections(
    channels: Collection[Connection], wanted: Callable[[str, str], bool]
) -> list[Connection]:
    """Return the connections that are wanted and whose type is known."""
    return [one for one in channels if wanted(one.topic, one.msgtype) and is_known(one.msgtype, one.msgdef)]


def _unreadable(path: Path, error: Exception) -> RecordingError:
    """Return the error for a file that the reader rejects."""
    what = " ".join(str(error).split()) or type(error).__name__
    return RecordingError(f"{path}: not a complete recording: {what}")


def _recovered_messages(
    path: Path, wanted: Callable[[str, str], bool], notify: Callable[[str], None] | None
) -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """Yield the complete messages of a truncated MCAP file."""
    kept = recovery_summary(path)
    if not kept:
        raise RecordingError(f"{path}: the recording is truncated and holds no complete chunk")
    text = f"recording: it is truncated; {kept} are readable"
    _report(path, text, notify)
    for one in recover_messages(path):
        if wanted(one.topic, one.typename) and is_known(one.typename, one.definition):
            yield one.topic, one.time, partial(_deserialize, one.data, one.typename, one.definition)


def warn_of_unused_gains(path: Path | str) -> None:
    """Warn that a recording holds its gains, so that those given with --gains are not used.

    Args:
        path: The recording.
    """
    warnings.warn(f"{path}: kp, kd: the commands hold them, so --gains is not used", stacklevel=3)
