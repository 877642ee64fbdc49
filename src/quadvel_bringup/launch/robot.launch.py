"""Launch a robot under ROS 2: low-level interface, estimator, controller and command mux.

`Stack` names these nodes; follow.launch.py starts the planner that follows a person.

ros2 launch quadvel_bringup robot.launch.py terrain:=rough
ros2 launch quadvel_bringup robot.launch.py low_level:=driver robot:=aliengo
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.action import Action
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from quadvel_bringup.nodes import launch_arguments
from quadvel_bringup.stack import LOW_LEVELS, PARAMETERS, Stack

ARGUMENTS = [
    DeclareLaunchArgument(
        "low_level", default_value="sim", choices=list(LOW_LEVELS), description="simulated or real robot"
    ),
    DeclareLaunchArgument(
        "robot", default_value="", description="aliengo, go2, or a robot.yaml or its folder; empty: aliengo"
    ),
    DeclareLaunchArgument("policy", default_value="", description="ONNX file; empty: the shipped one"),
    DeclareLaunchArgument(
        "actuator",
        default_value="",
        description="YAML file of an actuator model, as identify writes it; empty: the shipped one",
    ),
    DeclareLaunchArgument(
        "estimator",
        default_value="",
        choices=["", "learned", "kalman"],
        description="estimator of the linear velocity; empty: as in params",
    ),
    DeclareLaunchArgument("terrain", default_value="", description="flat, slope or rough; empty: flat"),
    DeclareLaunchArgument(
        "world", default_value="", description="corridor, park, campus or a file; empty: none"
    ),
    DeclareLaunchArgument("params", default_value=str(PARAMETERS), description="YAML file of parameters"),
    DeclareLaunchArgument("rviz", default_value="false", choices=["true", "false"], description="start RViz"),
    DeclareLaunchArgument(
        "use_sim_time",
        default_value="false",
        choices=["true", "false"],
        description="true: in lockstep with the simulator's clock; false: in real time",
    ),
]
NAMES = [argument.name for argument in ARGUMENTS]


def start(context: LaunchContext) -> list[Action]:
    """Return the nodes for the chosen arguments.

    Args:
        context: The launch context with the arguments.

    Returns:
        Nodes of the robot, and RViz if chosen.
    """
    chosen = {name: LaunchConfiguration(name).perform(context) for name in NAMES}
    stack = Stack(
        low_level=chosen["low_level"],
        robot=chosen["robot"] or None,
        policy=Path(chosen["policy"]) if chosen["policy"] else None,
        actuator=Path(chosen["actuator"]) if chosen["actuator"] else None,
        estimator=chosen["estimator"] or None,
        terrain=chosen["terrain"] or None,
        world=chosen["world"] or None,
        parameters=Path(chosen["params"]),
        use_sim_time=chosen["use_sim_time"] == "true",
    )
    actions: list[Action] = [
        Node(
            **launch_arguments(name),
            parameters=[str(stack.parameters), *([overrides] if overrides else [])],
            on_exit=EmitEvent(event=Shutdown(reason=f"{name} ended")),
        )
        for name, overrides in stack.node_parameters().items()
    ]
    shared = {"use_sim_time": stack.use_sim_time}
    if chosen["rviz"] == "true":
        config = str(PARAMETERS.parent / "robot.rviz")
        actions.append(
            Node(package="rviz2", executable="rviz2", arguments=["-d", config], parameters=[shared])
        )
    return actions


def generate_launch_description() -> LaunchDescription:
    """Return the nodes of a robot.

    Returns:
        The launch description.
    """
    return LaunchDescription([*ARGUMENTS, OpaqueFunction(function=start)])
