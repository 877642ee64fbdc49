"""Beside robot.launch.py: finds persons in the scans of a 2-D laser and follows the one who is meant.

ros2 launch quadvel_bringup follow.launch.py params:=my.yaml
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from quadvel_bringup.nodes import NODES
from quadvel_bringup.stack import PARAMETERS


def generate_launch_description() -> LaunchDescription:
    parameters = DeclareLaunchArgument(
        "params", default_value=str(PARAMETERS), description="YAML file of parameters"
    )
    nodes = [
        Node(
            package=NODES[name].package,
            executable=name,
            name=name,
            output="screen",
            parameters=[LaunchConfiguration("params")],
        )
        for name in ("person_tracker", "follow_planner")
    ]
    return LaunchDescription([parameters, *nodes])
