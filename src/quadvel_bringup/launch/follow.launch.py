"""Launch person tracker and follow planner next to robot.launch.py.

ros2 launch quadvel_bringup follow.launch.py params:=my.yaml
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from quadvel_bringup.nodes import launch_arguments
from quadvel_bringup.stack import PARAMETERS

ARGUMENTS = [
    DeclareLaunchArgument("params", default_value=str(PARAMETERS), description="YAML file of parameters"),
    DeclareLaunchArgument(
        "use_sim_time",
        default_value="false",
        choices=["true", "false"],
        description="true: simulated time, as robot.launch.py with it; false: real time",
    ),
]


def generate_launch_description() -> LaunchDescription:
    """Return person tracker and follow planner.

    Returns:
        The launch description.
    """
    sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    nodes = [
        Node(
            **launch_arguments(name),
            parameters=[LaunchConfiguration("params"), {"use_sim_time": sim_time}],
            on_exit=EmitEvent(event=Shutdown(reason=f"{name} ended")),
        )
        for name in ("person_tracker", "follow_planner")
    ]
    return LaunchDescription([*ARGUMENTS, *nodes])
