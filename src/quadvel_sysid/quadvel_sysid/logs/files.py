"""Named arrays out of files of all formats, whatever they are called there.

Sizes are looked at before anything is read: a file may promise more than memory holds. Nothing is unpickled.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

from . import archives, csv_table, documents, formats, hdf5, lerobot, matlab, parquet
from .log import LogError
from .raw import Choose, Raw


def _parquet(path: Path, choose: Choose) -> Raw:
    """One file, with the names of the joints where it belongs to a LeRobot data set."""
    return lerobot.read(path, choose) if lerobot.root_of(path) else parquet.read(path, choose)


READERS: Mapping[str, Callable[[Path, Choose], Raw]] = {
    ".npz": archives.read_npz,
    ".npy": archives.read_npy,
    ".csv": csv_table.read,
    ".tsv": csv_table.read,
    ".txt": csv_table.read,
    ".json": documents.read,
    ".mat": matlab.read,
    ".h5": hdf5.read,
    ".hdf5": hdf5.read,
    ".parquet": _parquet,
}


def read(path: Path, choose: Choose) -> Raw:
    """The arrays of the file at `path`, by its suffix; `.gz` behind it says that it is compressed. Raises LogError."""
    if path.is_dir():
        return lerobot.read(path, choose)
    packed = path.suffix == ".gz"
    suffix = (path.suffixes[-2:-1] or [""])[0] if packed else path.suffix
    reader = READERS.get(suffix.lower())
    if reader is None or (packed and reader not in (csv_table.read, documents.read)):
        raise LogError(formats.refusal(path, READERS))
    try:
        return reader(path, choose)
    except (zlib.error, EOFError, gzip.BadGzipFile) as error:
        raise LogError(f"{path}: no whole file: {error or 'it is cut off'}") from None
