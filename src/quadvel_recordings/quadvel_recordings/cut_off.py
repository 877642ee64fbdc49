"""What can be read of an MCAP file whose recorder was killed: the chunks that reached the disk whole.

Such a file has no summary and no end, and perhaps half a chunk.
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
class Kept:
    """A message of a cut-off file: its topic, its type's name and definition, when it was written (ns), and its bytes."""

    topic: str
    typename: str
    definition: MessageDefinition
    time: int
    data: bytes


def is_cut_off(path: Path) -> bool:
    """Whether the file begins as MCAP files do and does not end as they do."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        begins = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
        file.seek(max(path.stat().st_size - len(MCAP0_MAGIC), 0))
        return begins and (path.stat().st_size == len(MCAP0_MAGIC) or file.read() != MCAP0_MAGIC)


def kept_messages(path: Path) -> Iterator[Kept]:
    """The messages up to the first record that is not whole, in the order in which they were written."""
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
            yield Kept(channel.topic, schema.name, _definition(schema), record.log_time, record.data)


def _definition(schema: Schema) -> MessageDefinition:
    """As rosbags has it; that of an IDL file is left out, as nobody reads it."""
    if schema.encoding != "ros2msg":
        return MessageDefinition(MessageDefinitionFormat.NONE, "")
    return MessageDefinition(MessageDefinitionFormat.MSG, schema.data.decode(errors="replace"))


def what_is_kept(path: Path) -> str:
    """How much of the file is whole, in words, or "" where nothing is. It reads the whole file."""
    count, first, last = 0, 0, 0
    for message in kept_messages(path):
        first = min(first, message.time) if count else message.time
        last = max(last, message.time)
        count += 1
    return f"the first {1e-9 * (last - first):.1f} s, {count} messages" if count else ""


def _records(path: Path) -> Iterator[McapRecord]:
    """Records outside of chunks and in them, as long as they are whole."""
    with path.open("rb") as file:
        records = StreamReader(file, emit_chunks=True, record_size_limit=path.stat().st_size).records
        try:
            for record in records:
                yield from (
                    breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else (record,)
                )
        except Exception:  # a record that ends too early fails anywhere in reader, decompression or check sum
            return
