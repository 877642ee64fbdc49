"""Read a log from a path, in any supported format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import attrs

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import robot_of_file
from quadvel_description.robot_name import described_robot
from quadvel_recordings.joint_log import robot_of_types
from quadvel_recordings.reading import recorded_description
from quadvel_recordings.reading import topics as recorded_topics

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
    named = likely = None
    warnings: list[str] = []
    if path.suffix in (".mcap", ".db3", ".bag") or (path.is_dir() and lerobot.find_root(path) != path):
        log = read_recording(path, topics or Topics())
        named = described_robot(recorded_description(path))
        likely = robot_of_types(recorded_topics(path).values())
        if names and (names.sources or names.joints):
            warnings = ["--columns: not used, as this is a recording, whose messages name their fields"]
    else:
        log = read_table(path, names or ColumnMap())
        if topics and (topics.state or topics.command):
            warnings = ["--state-topic, --command-topic: not used, as this is a table, which has no topics"]
    remarks = list(log.remarks)
    on_bench = not set(log.joints) & set(JOINT_NAMES)
    notify = None if on_bench else remarks.append
    try:
        found = robot_of_file(path, named, robot, likely, notify)
    except ValueError as error:
        raise LogError(str(error)) from None
    if on_bench and robot is None:
        remarks.append(
            f"robot: none, as the joints are not a quadruped's; the model has the torque limits of {found.title}: "
            "write yours into `torque_limit` of actuator.yaml"
        )
    log = attrs.evolve(log, robot=found, remarks=tuple(remarks), warnings=(*log.warnings, *warnings))
    return log if joints is None else log.select_joints(joints)
