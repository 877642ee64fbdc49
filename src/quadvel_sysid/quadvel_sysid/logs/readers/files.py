"""Table of the file readers by suffix.

Readers check sizes before they unpack anything, since a file may declare more than memory holds.
No reader unpickles.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

from ..log import LogError
from . import archives, csv_table, documents, formats, hdf5, lerobot, matlab, parquet
from .raw import ColumnChooser, RawArrays


def _parquet(path: Path, choose: ColumnChooser) -> RawArrays:
    """Read one Parquet file, with joint names from the LeRobot data set that it belongs to, if any."""
    return (
        lerobot.read_lerobot(path, choose) if lerobot.find_root(path) else parquet.read_parquet(path, choose)
    )


READERS: Mapping[str, Callable[[Path, ColumnChooser], RawArrays]] = {
    ".npz": archives.read_npz,
    ".npy": archives.read_npy,
    ".csv": csv_table.read,
    ".tsv": csv_table.read,
    ".txt": csv_table.read,
    ".json": documents.read_json,
    ".mat": matlab.read_mat,
    ".h5": hdf5.read_hdf5,
    ".hdf5": hdf5.read_hdf5,
    ".parquet": _parquet,
}
"""Reader of each suffix."""


def read_file(path: Path, choose: ColumnChooser) -> RawArrays:
    """Read named arrays from a file, or from the folder of a LeRobot data set.

    Args:
        path: The file; its suffix selects the reader. `.gz` marks a compressed table or JSON
            document.
        choose: Selects the arrays to read.

    Returns:
        The selected arrays.

    Raises:
        LogError: The format is not supported, or the file is damaged.
    """
    if path.is_dir():
        return lerobot.read_lerobot(path, choose)
    packed = path.suffix == ".gz"
    suffix = Path(path.stem).suffix if packed else path.suffix
    reader = READERS.get(suffix.lower())
    if reader is None or (packed and reader not in (csv_table.read, documents.read_json)):
        raise LogError(formats.unreadable_reason(path, READERS))
    try:
        return reader(path, choose)
    except (zlib.error, EOFError, gzip.BadGzipFile) as error:
        raise LogError(f"{path}: not a complete file: {error or 'it is cut off'}") from None
