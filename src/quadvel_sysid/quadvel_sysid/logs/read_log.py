"""From a path to a `Log`, by what the file is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .log import Log, LogError
from .recordings import read as read_recording
from .tables import read_csv, read_npz


def read_log(path: str | Path, joints: Sequence[str] | None = None) -> Log:
    """The log at `path`: an .mcap file, a rosbag2 folder, an .npz or a .csv; only `joints` where they are given.

    Raises LogError, one sentence that names the file and the field, and OSError where there is no such file.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if path.is_dir() or path.suffix in (".mcap", ".db3"):
        log = read_recording(path)
    elif path.suffix == ".npz":
        log = read_npz(path)
    elif path.suffix == ".csv":
        log = read_csv(path)
    else:
        raise LogError(
            f"{path}: the suffix is '{path.suffix}', expected .mcap, .npz, .csv or a rosbag2 folder"
        )
    return log if joints is None else log.select(joints)
