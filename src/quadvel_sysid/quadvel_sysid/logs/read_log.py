"""From a path to a `Log`, by what the file is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from . import lerobot
from .columns import ColumnMap
from .log import Log
from .recordings import Topics
from .recordings import read as read_recording
from .tables import read_table


def read_log(
    path: str | Path,
    joints: Sequence[str] | None = None,
    names: ColumnMap | None = None,
    topics: Topics | None = None,
) -> Log:
    """The log at `path`, whatever its format.

    Args:
        path: a recording (MCAP, rosbag2, ROS 1) or a table of `files.READERS`.
        joints: use these joints only.
        names: what the fields are called in a table.
        topics: which topics of a recording hold the log.

    Raises:
        LogError: one sentence that names the file and the field.
        OSError: there is no such file.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if path.suffix in (".mcap", ".db3", ".bag") or (path.is_dir() and lerobot.root_of(path) != path):
        log = read_recording(path, topics or Topics())
    else:
        log = read_table(path, names or ColumnMap())
    return log if joints is None else log.select(joints)
