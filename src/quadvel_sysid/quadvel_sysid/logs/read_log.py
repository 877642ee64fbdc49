"""Read a log from a path, in any supported format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import attrs

from quadvel_description.robot import robot_of_file
from quadvel_description.robot_name import described_robot
from quadvel_recordings.reading import recorded_description

from .log import Log, LogError
from .readers import lerobot
from .readers.columns import ColumnMap
from .readers.recordings import Topics, read_recording
from .readers.tables import read_table


def read_log(
    path: str | Path,
    joints: Sequence[str] | None = None,
    names: ColumnMap | None = None,
    topics: Topics | None = None,
    robot: str | None = None,
) -> Log:
    """Read a measured joint log.

    Args:
        path: A recording (MCAP, rosbag2, ROS 1), or a table with a suffix of `files.READERS`.
        joints: Names of the joints to keep, or None for all.
        names: Names of the fields in a table.
        topics: Topics of a recording that hold the log.
        robot: Name or file of the robot; None for the one that a recording names.

    Returns:
        The log, with checked shapes, numbers and times.

    Raises:
        LogError: The file cannot be used, or is that of another robot; the message names the file
            and the field.
        FileNotFoundError: There is no such file.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if path.suffix in (".mcap", ".db3", ".bag") or (path.is_dir() and lerobot.find_root(path) != path):
        log = read_recording(path, topics or Topics())
        named = described_robot(recorded_description(path))
    else:
        log, named = read_table(path, names or ColumnMap()), None
    try:
        log = attrs.evolve(log, robot=robot_of_file(path, named, robot))
    except ValueError as error:
        raise LogError(str(error)) from None
    return log if joints is None else log.select_joints(joints)
