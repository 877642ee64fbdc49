"""robot.launch.py under the name that it had before, with the same arguments."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

ROBOT = Path(__file__).with_name("robot.launch.py")


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([IncludeLaunchDescription(PythonLaunchDescriptionSource(str(ROBOT)))])
