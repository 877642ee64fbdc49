"""Limits on the decompressed size of recordings: a small file can expand beyond memory or disk."""

from __future__ import annotations

import bz2
import shutil
import struct
import tempfile
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import attrs
import lz4.frame
from backports import zstd

MAX_CHUNK_BYTES = 1 << 28
"""Largest decompressed size of a chunk or message; recorders write chunks of a few megabytes."""
MAX_OVERLAP_BYTES = 1 << 30
"""Largest decompressed size of all MCAP chunks that cover one instant.

A reader holds these together.
"""
BLOCK_BYTES = 1 << 20
"""Bytes that are decompressed per step while the size is counted."""

CHUNK_OPCODE, RECORD_HEADER = 0x06, struct.Struct("<BQ")
CHUNK_HEADER, LENGTH = struct.Struct("<QQQL"), struct.Struct("<L")
MAGIC = b"\x89MCAP0\r\n"
_UNPACKERS: dict[str, Callable[[], Any]] = {
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


class TooLargeError(ValueError):
    """Decompressed data exceeds a limit; the message does not name the file."""


@attrs.frozen
class _Chunk:
    """The header of an MCAP chunk.

    Attributes:
        first: Time of its first message, ns.
        last: Time of its last message, ns.
        size: Decompressed size as the header states it, bytes.
        compression: Name of the compression.
    """

    first: int
    last: int
    size: int
    compression: str


def decompress(data: bytes, compression: str, max_bytes: int = MAX_CHUNK_BYTES) -> bytes:
    """Decompress data up to a size limit.

    Args:
        data: Compressed bytes of one or several frames.
        compression: "lz4", "zstd" or "bz2".
        max_bytes: Largest size of the result.

    Returns:
        The decompressed bytes.

    Raises:
        TooLargeError: The result would exceed `max_bytes`. Errors of the decompressors pass
            through.
    """
    out = bytearray()
    for part in _decompressed_blocks(BytesIO(data), compression):
        out += part
        if len(out) > max_bytes:
            raise TooLargeError(f"found a chunk of more than {max_bytes} bytes, expected fewer")
    return bytes(out)


def _decompressed_blocks(file: IO[bytes], compression: str) -> Iterator[bytes]:
    """Yield the decompressed content of one or several frames, block by block."""
    rest = file.read(BLOCK_BYTES)
    while rest:
        unpacker = _UNPACKERS[compression]()
        while not unpacker.eof:
            yield unpacker.decompress(rest, BLOCK_BYTES)
            rest = file.read(BLOCK_BYTES) if unpacker.needs_input else b""
            if unpacker.needs_input and not rest and not unpacker.eof:
                return
        rest = (unpacker.unused_data or b"") + file.read(BLOCK_BYTES)


def check_chunks(path: Path) -> None:
    """Check the decompressed size of all chunks of an MCAP file.

    Of a damaged file the intact chunks are checked.

    Args:
        path: The MCAP file.

    Raises:
        TooLargeError: A chunk exceeds `MAX_CHUNK_BYTES`, or overlapping chunks exceed
            `MAX_OVERLAP_BYTES`.
    """
    chunks = []
    with path.open("rb") as file:
        for chunk, data in _chunks(file):
            if chunk.size > MAX_CHUNK_BYTES:
                raise TooLargeError(
                    f"found a chunk of {chunk.size} bytes, expected {MAX_CHUNK_BYTES} at most"
                )
            if chunk.compression in _UNPACKERS:
                _check_size(data, chunk.compression, MAX_CHUNK_BYTES)
            chunks.append(chunk)
    most = _peak_bytes(chunks)
    if most > MAX_OVERLAP_BYTES:
        raise TooLargeError(
            f"found chunks of {most} bytes that hold the same instant, expected {MAX_OVERLAP_BYTES} at most"
        )


def _check_size(data: bytes, compression: str, max_bytes: int) -> None:
    """Raise TooLargeError if the data expands beyond the limit.

    Damaged data is left to the reader to reject.
    """
    total = 0
    try:
        for part in _decompressed_blocks(BytesIO(data), compression):
            total += len(part)
            if total > max_bytes:
                raise TooLargeError(f"found a chunk of more than {max_bytes} bytes, expected fewer")
    except TooLargeError:
        raise
    except Exception:
        return


def _chunks(file: IO[bytes]) -> Iterator[tuple[_Chunk, bytes]]:
    """Yield the header and the compressed data of each complete chunk of an MCAP file."""
    end = file.seek(0, 2)
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        return
    while len(head := file.read(RECORD_HEADER.size)) == RECORD_HEADER.size:
        kind, length = RECORD_HEADER.unpack(head)
        begin = file.tell()
        if not kind or begin + length > end:
            return
        if kind == CHUNK_OPCODE and length > CHUNK_HEADER.size + LENGTH.size:
            first, last, size, _ = CHUNK_HEADER.unpack(file.read(CHUNK_HEADER.size))
            (letters,) = LENGTH.unpack(file.read(LENGTH.size))
            compression = file.read(min(letters, 16)).decode(errors="replace")
            file.seek(8, 1)
            yield _Chunk(first, last, size, compression), file.read(max(0, begin + length - file.tell()))
        file.seek(begin + length)


def _peak_bytes(chunks: list[_Chunk]) -> int:
    """Return the largest total size of chunks that cover one instant, bytes."""
    # Sweep over time: a chunk adds its size at its first message and removes it after its last.
    changes = [(chunk.first, chunk.size) for chunk in chunks] + [
        (chunk.last + 1, -chunk.size) for chunk in chunks
    ]
    most = now = 0
    for _, change in sorted(changes):
        now += change
        most = max(most, now)
    return most


def check_packed_file(path: Path) -> None:
    """Check that a compressed rosbag2 file fits on the disk to which it is decompressed.

    Args:
        path: The compressed file (`.zstd`).

    Raises:
        TooLargeError: The file expands to more than half of the free space of the temporary folder.
    """
    free = shutil.disk_usage(tempfile.gettempdir()).free // 2
    total = 0
    with path.open("rb") as file:
        for part in _decompressed_blocks(file, "zstd"):
            total += len(part)
            if total > free:
                raise TooLargeError(f"{path.name}: unpacks to more than {free} bytes, half of the free disk")
