"""A recorded scripted walk: the stack and the planner of a script."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from typing_extensions import override

from quadvel_bringup.nodes import enclave, process_command
from quadvel_eval.script import SCRIPTS

from .recorded_run import POLL_PERIOD_S, RecordedRun

PLANNED = {"/cmd_vel": "geometry_msgs/msg/Twist", "/planner/step": "std_msgs/msg/String"}
TRUTH = "/ground_truth/odom"
"""Topic without which no walk can be judged; it is published once its publisher knows the recorder."""
MAX_WAIT_S = 20.0
"""Real time within which it has to be heard; the script then starts all the same."""


class ScriptedWalk(RecordedRun):
    """A run that ends when the planner has completed its script.

    The script starts once the recorder hears the robot and knows the planner: in lockstep, simulated time
    may pass faster than processes find each other.

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
        self._has_started, self._start_by = False, float("inf")  # s of the monotonic clock
        parameters = {"script": script, "wait": "true", "use_sim_time": str(lockstep).lower()}
        arguments = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        planner = {"planner": process_command("planner", ["--ros-args", *enclave("planner"), *arguments])}
        super().__init__(recording, {**nodes, **planner}, PLANNED, lockstep, console, len(self._steps))

    @override
    def listen(self, node: Any, recorded: Mapping[str, int]) -> None:
        from rclpy.clock import Clock, ClockType
        from std_msgs.msg import String
        from std_srvs.srv import Trigger

        node.create_subscription(String, "planner/step", self._on_step, 10)
        self._start_by = time.monotonic() + MAX_WAIT_S
        start = node.create_client(Trigger, "planner/start")

        def start_script() -> None:
            is_heard = TRUTH in recorded or time.monotonic() > self._start_by
            if is_heard and not self._has_started and start.service_is_ready():
                start.call_async(Trigger.Request())  # until a step is announced: requests can be lost

        node.create_timer(POLL_PERIOD_S, start_script, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @override
    def is_over(self, ended: Mapping[str, int]) -> bool:
        # The planner, and no other process, ended with 0.
        return dict(ended) == {"planner": 0}

    @override
    def failure(self) -> str:
        if self._has_started or time.monotonic() < self._start_by + MAX_WAIT_S:
            return ""
        return f"the planner did not start its script within {2.0 * MAX_WAIT_S:.0f} s"

    def _on_step(self, message: Any) -> None:
        """Update the bar."""
        self._has_started = True
        self._bar.update(self._task, completed=self._steps.index(message.data), description=message.data)
