"""How much a packed recording may unpack to: a small file can promise more than memory or disk holds."""

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

LARGEST_CHUNK = 1 << 28
"""Bytes of a chunk or message once unpacked: recorders write chunks of some MB."""
LARGEST_AT_ONCE = 1 << 30
"""Bytes of all chunks of an MCAP file that hold the same instant, which a reader keeps at once."""
STEP = 1 << 20
"""Bytes that are unpacked at once while they are counted."""

CHUNK, RECORD = 0x06, struct.Struct("<BQ")
CHUNK_HEAD, LENGTH = struct.Struct("<QQQL"), struct.Struct("<L")
MAGIC = b"\x89MCAP0\r\n"
_UNPACKERS: dict[str, Callable[[], Any]] = {
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


class TooLargeError(ValueError):
    """More is packed in a recording than may be unpacked; the sentence lacks the file's name."""


@attrs.frozen
class _Chunk:
    """A chunk of an MCAP file: the times (ns) that it holds, what it says that it unpacks to, and how it is packed."""

    first: int
    last: int
    size: int
    compression: str


def unpacked(data: bytes, compression: str, largest: int = LARGEST_CHUNK) -> bytes:
    """The data unpacked. Raises TooLargeError before more than `largest` bytes are, and what the packers raise."""
    out = bytearray()
    for part in _parts(BytesIO(data), compression):
        out += part
        if len(out) > largest:
            raise TooLargeError(f"found a chunk of more than {largest} bytes, expected fewer")
    return bytes(out)


def _parts(file: IO[bytes], compression: str) -> Iterator[bytes]:
    """What is packed in one or several frames, in steps."""
    rest = file.read(STEP)
    while rest:
        unpacker = _UNPACKERS[compression]()
        while not unpacker.eof:
            yield unpacker.decompress(rest, STEP)
            rest = file.read(STEP) if unpacker.needs_input else b""
            if unpacker.needs_input and not rest and not unpacker.eof:
                return
        rest = (unpacker.unused_data or b"") + file.read(STEP)


def check_chunks(path: Path) -> None:
    """Raises TooLargeError where chunks of an MCAP file unpack to more than they may; of a broken file what is whole counts."""
    chunks = []
    with path.open("rb") as file:
        for chunk, data in _chunks(file):
            if chunk.size > LARGEST_CHUNK:
                raise TooLargeError(f"found a chunk of {chunk.size} bytes, expected {LARGEST_CHUNK} at most")
            if chunk.compression in _UNPACKERS:
                _count(data, chunk.compression, LARGEST_CHUNK)
            chunks.append(chunk)
    most = _most_at_once(chunks)
    if most > LARGEST_AT_ONCE:
        raise TooLargeError(
            f"found chunks of {most} bytes that hold the same instant, expected {LARGEST_AT_ONCE} at most"
        )


def _count(data: bytes, compression: str, largest: int) -> None:
    """Raises TooLargeError where more is packed; broken data is the reader's to refuse."""
    total = 0
    try:
        for part in _parts(BytesIO(data), compression):
            total += len(part)
            if total > largest:
                raise TooLargeError(f"found a chunk of more than {largest} bytes, expected fewer")
    except TooLargeError:
        raise
    except Exception:
        return


def _chunks(file: IO[bytes]) -> Iterator[tuple[_Chunk, bytes]]:
    """Each whole chunk of an MCAP file, with its packed data."""
    end = file.seek(0, 2)
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        return
    while len(head := file.read(RECORD.size)) == RECORD.size:
        kind, length = RECORD.unpack(head)
        begin = file.tell()
        if not kind or begin + length > end:
            return
        if kind == CHUNK and length > CHUNK_HEAD.size + LENGTH.size:
            first, last, size, _ = CHUNK_HEAD.unpack(file.read(CHUNK_HEAD.size))
            (letters,) = LENGTH.unpack(file.read(LENGTH.size))
            compression = file.read(min(letters, 16)).decode(errors="replace")
            file.seek(8, 1)
            yield _Chunk(first, last, size, compression), file.read(max(0, begin + length - file.tell()))
        file.seek(begin + length)


def _most_at_once(chunks: list[_Chunk]) -> int:
    """Bytes of the chunks that hold one instant, at most."""
    changes = [(chunk.first, chunk.size) for chunk in chunks] + [
        (chunk.last + 1, -chunk.size) for chunk in chunks
    ]
    most = now = 0
    for _, change in sorted(changes):
        now += change
        most = max(most, now)
    return most


def check_packed_file(path: Path) -> None:
    """Raises TooLargeError where a packed file of a rosbag2 needs more than half of the free disk, to which it is unpacked."""
    free = shutil.disk_usage(tempfile.gettempdir()).free // 2
    total = 0
    with path.open("rb") as file:
        for part in _parts(file, "zstd"):
            total += len(part)
            if total > free:
                raise TooLargeError(f"{path.name}: unpacks to more than {free} bytes, half of the free disk")
