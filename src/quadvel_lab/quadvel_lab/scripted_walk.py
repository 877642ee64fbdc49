"""A recorded scripted walk: the stack and the planner of a script."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from typing_extensions import override

from quadvel_bringup.nodes import enclave, process_command
from quadvel_eval.script import SCRIPTS

from .recorded_run import RecordedRun

PLANNED = {"/cmd_vel": "geometry_msgs/msg/Twist", "/planner/step": "std_msgs/msg/String"}


class ScriptedWalk(RecordedRun):
    """A run that ends when the planner has completed its script.

    Args:
        recording: The MCAP file to write.
        script: Name of the script.
        nodes: Command lines by name; the planner is added.
        lockstep: Whether the nodes use simulated time.
        console: Console for output and bar.
    """

    def __init__(
        self,
        recording: Path,
        script: str,
        nodes: Mapping[str, Sequence[str]],
        lockstep: bool,
        console: Console,
    ) -> None:

        self._steps = [step.name for step in SCRIPTS[script]]
        parameters = {"script": script, "use_sim_time": str(lockstep).lower()}
        arguments = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        planner = {"planner": process_command("planner", ["--ros-args", *enclave("planner"), *arguments])}
        super().__init__(recording, {**nodes, **planner}, PLANNED, lockstep, console, len(self._steps))

    @override
    def listen(self, node: Any) -> None:
        from std_msgs.msg import String

        node.create_subscription(String, "planner/step", self._on_step, 10)

    @override
    def is_over(self, ended: Mapping[str, int]) -> bool:
        # The planner, and no other process, ended with 0.
        return dict(ended) == {"planner": 0}

    def _on_step(self, message: Any) -> None:
        """Update the bar."""
        self._bar.update(self._task, completed=self._steps.index(message.data), description=message.data)
