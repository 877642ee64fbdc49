"""A scripted walk: the stack, driven by the planner of a script, and all that they say recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from quadvel_eval.script import SCRIPTS

from .nodes import command, enclave
from .recorded_run import RecordedRun

PLANNED = {"/cmd_vel": "geometry_msgs/msg/Twist", "/planner/step": "std_msgs/msg/String"}


class ScriptedWalk(RecordedRun):
    """Over once the planner has walked its script to the end."""

    def __init__(
        self,
        recording: Path,
        script: str,
        nodes: Mapping[str, Sequence[str]],
        lockstep: bool,
        console: Console,
    ) -> None:
        """nodes: command line of each, by name; the planner comes on top. lockstep: they keep simulated time."""
        self._steps = [step.name for step in SCRIPTS[script]]
        parameters = {"script": script, "use_sim_time": str(lockstep).lower()}
        arguments = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        planner = {"planner": command("planner", ["--ros-args", *enclave("planner"), *arguments])}
        super().__init__(recording, {**nodes, **planner}, PLANNED, lockstep, console, len(self._steps))

    def listen(self, node: Any) -> None:
        from std_msgs.msg import String

        node.create_subscription(String, "planner/step", self._on_step, 10)

    def is_over(self, ended: Mapping[str, int]) -> bool:
        return dict(ended) == {"planner": 0}

    def _on_step(self, message: Any) -> None:
        self._bar.update(self._task, completed=self._steps.index(message.data), description=message.data)
