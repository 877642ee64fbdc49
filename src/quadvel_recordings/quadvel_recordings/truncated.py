"""Recovery of MCAP files whose recorder was killed: all chunks that are complete on disk.

Such a file has no summary and no footer, and may end within a chunk.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import attrs
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat


@attrs.frozen
class RecoveredMessage:
    """A message of a truncated file.

    Attributes:
        topic: Its topic.
        typename: Its type, such as "geometry_msgs/msg/Twist".
        definition: The definition of that type in the file.
        time: When it was written, ns.
        data: The serialised message.
    """

    topic: str
    typename: str
    definition: MessageDefinition
    time: int
    data: bytes


def is_truncated(path: Path) -> bool:
    """Return whether a file starts with the MCAP magic bytes but does not end with them.

    Args:
        path: The file; anything else than a file counts as not truncated.

    Returns:
        True for an MCAP file without a footer.
    """
    if not path.is_file():
        return False
    with path.open("rb") as file:
        begins = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
        file.seek(max(path.stat().st_size - len(MCAP0_MAGIC), 0))
        return begins and (path.stat().st_size == len(MCAP0_MAGIC) or file.read() != MCAP0_MAGIC)


def recover_messages(path: Path) -> Iterator[RecoveredMessage]:
    """Yield the messages before the first incomplete record.

    Args:
        path: A truncated MCAP file.

    Yields:
        The messages in the order in which they were written.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in _records(path):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels[record.channel_id]
            schema = schemas[channel.schema_id]
            yield RecoveredMessage(
                channel.topic, schema.name, _definition(schema), record.log_time, record.data
            )


def _definition(schema: Schema) -> MessageDefinition:
    """Convert a schema to a definition of rosbags.

    IDL definitions are not read, so they become empty.
    """
    if schema.encoding != "ros2msg":
        return MessageDefinition(MessageDefinitionFormat.NONE, "")
    return MessageDefinition(MessageDefinitionFormat.MSG, schema.data.decode(errors="replace"))


def recovery_summary(path: Path) -> str:
    """Describe how much of a truncated file is readable. Reads the whole file.

    Args:
        path: A truncated MCAP file.

    Returns:
        Duration and number of messages in words, or "" if nothing is readable.
    """
    count, first, last = 0, 0, 0
    for message in recover_messages(path):
        first = min(first, message.time) if count else message.time
        last = max(last, message.time)
        count += 1
    return f"the first {1e-9 * (last - first):.1f} s, {count} messages" if count else ""


def _records(path: Path) -> Iterator[McapRecord]:
    """Yield the records inside and outside of chunks until the first incomplete one."""
    with path.open("rb") as file:
        records = StreamReader(file, emit_chunks=True, record_size_limit=path.stat().st_size).records
        try:
            for record in records:
                yield from (
                    breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else (record,)
                )
        except Exception:  # a record that ends too early fails anywhere in reader, decompression or check sum
            return
