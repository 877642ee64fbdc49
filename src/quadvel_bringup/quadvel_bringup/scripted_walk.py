"""A scripted walk: every node a process of its own, driven by the planner, and all that they say recorded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

import quadvel_dds
from quadvel_eval.script import SCRIPTS

from .alone import ensure_alone
from .node_output import PrefixedOutput
from .nodes import command, enclave
from .processes import ProcessGroup, StopSignals

RECORDED = {
    "/cmd_vel": "geometry_msgs/msg/Twist",
    "/command": "quadvel_msgs/msg/VelocityCommand",
    "/controller/state": "quadvel_msgs/msg/ControllerState",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/ground": "visualization_msgs/msg/Marker",
    "/ground_truth/odom": "nav_msgs/msg/Odometry",
    "/imu": "sensor_msgs/msg/Imu",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/low_cmd": "quadvel_msgs/msg/LowCmd",
    "/low_state": "quadvel_msgs/msg/LowState",
    "/odom": "nav_msgs/msg/Odometry",
    "/planner/step": "std_msgs/msg/String",
    "/robot_description": "std_msgs/msg/String",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/velocity_estimate": "geometry_msgs/msg/TwistWithCovarianceStamped",
}
LOOK = 0.2  # s, between two looks whether all nodes still run


class ScriptedWalk:
    """The nodes, the recorder in this process, and a bar that shows how far the script is."""

    def __init__(
        self,
        recording: Path,
        script: str,
        nodes: Mapping[str, Sequence[str]],
        lockstep: bool,
        console: Console,
    ) -> None:
        """nodes: command line of each, by name; the planner comes on top. lockstep: they keep simulated time."""
        self._recording = recording
        self._script = script
        self._nodes = nodes
        self._lockstep = lockstep
        self._steps = [step.name for step in SCRIPTS[script]]
        columns = (TextColumn("{task.description:24}"), BarColumn(), TimeElapsedColumn())
        self._bar = Progress(*columns, console=console)
        self._say = PrefixedOutput([*nodes, "planner"], console)
        self._task = self._bar.add_task("start", total=len(self._steps))

    def run(self) -> str:
        """Run the script to its end; what went wrong, or "". Ctrl-C ends it with a typer.Exit.

        Raises NotAlone where a robot is there already.
        """
        quadvel_dds.install()
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions
        from std_msgs.msg import String

        from .recorder import Recorder

        rclpy.init(args=["--ros-args", *enclave("recorder")], signal_handler_options=SignalHandlerOptions.NO)
        use_sim_time = Parameter("use_sim_time", value=self._lockstep)
        node = rclpy.create_node("recorder", parameter_overrides=[use_sim_time])
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        try:
            ensure_alone(node)
            node.create_subscription(String, "planner/step", self._on_step, 10)
            with StopSignals() as signals, Recorder(node, self._recording) as recorder, self._bar:
                for topic, kind in RECORDED.items():
                    recorder.record(topic, kind)
                with ProcessGroup(self._say) as group:
                    self._start(group)
                    problem = self._wait(group, signals, lambda: recorder.serve(executor, LOOK))
        finally:
            node.destroy_node()
            rclpy.try_shutdown()
        if signals.received:
            raise typer.Exit(128 + signals.received)
        return problem

    def _start(self, group: ProcessGroup) -> None:
        for name, line in self._nodes.items():
            group.start(name, line)
        planner = {"script": self._script, "use_sim_time": str(self._lockstep).lower()}
        arguments = [word for name, value in planner.items() for word in ("-p", f"{name}:={value}")]
        group.start("planner", command("planner", ["--ros-args", *enclave("planner"), *arguments]))

    def _wait(self, group: ProcessGroup, signals: StopSignals, record: Callable[[], None]) -> str:
        """Record until one of the nodes ends: the planner, if all goes well."""
        ended: dict[str, int] = {}
        while not ended and not signals.received:
            record()
            ended = group.ended()
        if ended == {"planner": 0}:
            self._bar.update(self._task, completed=len(self._steps), description="done")
            return ""
        return ", ".join(f"{name} ended with exit code {code}" for name, code in ended.items())

    def _on_step(self, message: Any) -> None:
        self._bar.update(self._task, completed=self._steps.index(message.data), description=message.data)
