"""The former name of robot.launch.py, with the same arguments."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

ROBOT = Path(__file__).with_name("robot.launch.py")


def generate_launch_description() -> LaunchDescription:
    """Include robot.launch.py.

    Returns:
        The launch description.
    """
    return LaunchDescription([IncludeLaunchDescription(PythonLaunchDescriptionSource(str(ROBOT)))])
