"""A recorded run of the stack for a demo.

Every node runs in its own process; this process records all topics.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

import quadvel_dds
from quadvel_bringup.exclusivity import domain_claimed
from quadvel_bringup.node_output import PrefixedOutput
from quadvel_bringup.nodes import enclave
from quadvel_bringup.page_watch import PageWatch
from quadvel_bringup.processes import ProcessGroup, StopSignals

RECORDED_TOPICS = {
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
    "/robot_description": "std_msgs/msg/String",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/velocity_estimate": "geometry_msgs/msg/TwistWithCovarianceStamped",
}
"""Topics and types that every run records; each run adds those of its planner."""
LOCKSTEP_HINT = "if this machine is slow or busy, use --lockstep: simulated time then waits for the nodes"
"""What to try if a run in real time failed."""
POLL_PERIOD_S = 0.2
"""Time between two checks of the nodes."""


class RecordedRun(ABC):
    """Runs nodes, recorder and progress bar.

    Args:
        recording: The MCAP file to write.
        nodes: Command lines by name, in the order of their start.
        topics: Types of topics to record besides RECORDED_TOPICS.
        lockstep: Whether the nodes use simulated time.
        console: Console for output and bar.
        total: Value of the completed bar.
    """

    def __init__(
        self,
        recording: Path,
        nodes: Mapping[str, Sequence[str]],
        topics: Mapping[str, str],
        lockstep: bool,
        console: Console,
        total: float,
    ) -> None:
        self._recording, self._nodes, self._topics, self._lockstep = recording, nodes, topics, lockstep
        columns = (TextColumn("{task.description:24}"), BarColumn(), TimeElapsedColumn())
        self._bar = Progress(*columns, console=console)
        self._output = PrefixedOutput(list(nodes), console)
        self._task = self._bar.add_task("start", total=total)

    @abstractmethod
    def listen(self, node: Any, recorded: Mapping[str, int]) -> None:
        """Subscribe to the topics that show the progress.

        Args:
            node: The recorder's node.
            recorded: Number of recorded messages by topic so far; a topic is absent until its first message.
        """

    @abstractmethod
    def is_over(self, ended: Mapping[str, int]) -> bool:
        """Return whether the run is complete and succeeded.

        Args:
            ended: Exit codes of ended processes by name.

        Returns:
            True if so; `failure` reports a run that can no longer complete.
        """

    def failure(self) -> str:
        """Return why the run cannot complete although all nodes run, or "".

        Returns:
            One sentence, or "" as long as it can.
        """
        return ""

    def run(self) -> str:
        """Run to the end. RobotAlreadyRunningError passes through.

        Returns:
            What went wrong, or "".

        Raises:
            typer.Exit: A signal ended the run.
        """
        quadvel_dds.install()
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions

        from quadvel_bringup.recorder import Recorder
        from quadvel_bringup.recording_file import RecordingFile

        rclpy.init(args=["--ros-args", *enclave("recorder")], signal_handler_options=SignalHandlerOptions.NO)
        use_sim_time = Parameter("use_sim_time", value=self._lockstep)
        node = rclpy.create_node("recorder", parameter_overrides=[use_sim_time])
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        try:
            with (
                domain_claimed(node),
                StopSignals() as signals,
                Recorder(node, RecordingFile(self._recording)) as recorder,
                self._bar,
            ):
                self.listen(node, recorder.counts)
                for topic, kind in {**RECORDED_TOPICS, **self._topics}.items():
                    recorder.record(topic, kind)
                with ProcessGroup(self._output) as group:
                    for name, line in self._nodes.items():
                        group.start(name, line)
                    problem = self._wait(group, signals, lambda: recorder.serve(executor, POLL_PERIOD_S))
        finally:
            node.destroy_node()
            rclpy.try_shutdown()
        if signals.received:
            raise typer.Exit(128 + signals.received)
        return problem

    def _wait(self, group: ProcessGroup, signals: StopSignals, record: Callable[[], None]) -> str:
        """Record until the run is complete, or a node ended unexpectedly."""
        watch = PageWatch(group, self._output)  # the operator page may end without ending the run
        ended: Mapping[str, int] = {}
        failure = ""
        while not (self.is_over(ended) or ended or failure or signals.received):
            record()
            ended, failure = watch.ended(), self.failure()
        if self.is_over(ended):
            self._bar.update(self._task, completed=self._bar.tasks[0].total, description="done")
            return ""
        return failure or ", ".join(f"{name} ended with exit code {code}" for name, code in ended.items())
