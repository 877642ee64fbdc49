"""`quadvel demo follow`: the robot follows a person through a simulated world.

It runs with one process per node, in real time or in lockstep. The tour of some kilometres runs in
one process instead, as fast as the machine permits (`quadvel_eval.following.tour`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from typing_extensions import override

from quadvel_bringup.nodes import process_command, ros_arguments
from quadvel_bringup.preflight import check_stack
from quadvel_bringup.stack import Stack
from quadvel_description.robot import load_robot
from quadvel_eval.following.recorded import read_following
from quadvel_eval.following.tour import load_followed_world
from quadvel_eval.following.tour_report import tour_table, write_tour
from quadvel_recordings.output import atomic_write
from quadvel_recordings.reading import RecordingError
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator

from .recorded_run import LOCKSTEP_HINT, RecordedRun

FOLLOW_TOPICS = {
    "/cmd_vel_follow": "geometry_msgs/msg/Twist",
    "/follow_planner/path": "nav_msgs/msg/Path",
    "/follow_planner/state": "std_msgs/msg/String",
    "/ground_truth/persons": "geometry_msgs/msg/PoseArray",
    "/person": "geometry_msgs/msg/PoseStamped",
    "/person/odometry": "nav_msgs/msg/Odometry",
    "/person_tracker/markers": "visualization_msgs/msg/MarkerArray",
    "/scan": "sensor_msgs/msg/LaserScan",
}
"""Topics and types that a following run records in addition."""


MAX_WAIT_S = 120.0
"""Real time within which the robot has to start to follow."""


class FollowedWalk(RecordedRun):
    """A run that ends a given time after the robot started to follow.

    Args:
        recording: The MCAP file to write.
        stack: The nodes and their parameters.
        laser: Position x, y of the laser on the robot, m.
        seconds: Duration, s, in the time of the nodes.
        view: Whether to add the operator page.
        console: Console for output and bar.
    """

    def __init__(
        self,
        recording: Path,
        stack: Stack,
        laser: tuple[float, float],
        seconds: float,
        view: bool,
        console: Console,
    ) -> None:

        place: dict[str, Any] = dict(zip(("laser_x", "laser_y"), laser, strict=True))
        if stack.use_sim_time:
            place["use_sim_time"] = True
        names = ("person_tracker", "follow_planner")
        followers = {
            name: process_command(name, ros_arguments(name, place, stack.parameters)) for name in names
        }
        super().__init__(
            recording,
            {**stack.commands(view), **followers},
            FOLLOW_TOPICS,
            stack.use_sim_time,
            console,
            seconds,
        )
        self._seconds = seconds
        self._began = float("inf")  # on the clock of the nodes
        self._created, self._last_state = time.monotonic(), "no state of the follow planner"

    @override
    def listen(self, node: Any, recorded: Mapping[str, int]) -> None:
        from std_msgs.msg import String

        self._clock = node.get_clock()
        node.create_subscription(String, "follow_planner/state", self._on_state, 10)

    @override
    def is_over(self, ended: Mapping[str, int]) -> bool:
        return not ended and self._now() - self._began > self._seconds

    @override
    def failure(self) -> str:
        if self._began < float("inf") or time.monotonic() - self._created < MAX_WAIT_S:
            return ""
        return f"the robot did not start to follow within {MAX_WAIT_S:.0f} s; last: {self._last_state}"

    def _now(self) -> float:
        """Return the time of the nodes, s."""
        return 1e-9 * float(self._clock.now().nanoseconds)

    def _on_state(self, message: Any) -> None:
        """Update the bar."""
        self._last_state = message.data
        state, words = message.data.split(": ", maxsplit=1)
        if state == "following" and self._began == float("inf"):
            self._began = self._now()
        passed = max(self._now() - self._began, 0.0)
        self._bar.update(self._task, completed=passed, description=words[:24])


def follow(
    folder: Path, robot: str, world: str, seconds: float, lockstep: bool, view: bool, console: Console
) -> bool:
    """Run, evaluate and write the results.

    Args:
        folder: Folder for the results.
        robot: Name of a shipped robot, or path of a robot.yaml.
        world: Name or file of the world.
        seconds: Duration, s.
        lockstep: Whether simulated time waits for the controller, instead of real time.
        view: Whether to add the operator page.
        console: Console for the report.

    Returns:
        Whether the robot neither fell nor touched anything.
    """
    stack, loaded = Stack(robot=robot, world=world, use_sim_time=lockstep), load_followed_world(world)
    Simulator(SimulatorConfig(robot=load_robot(robot), world=loaded))  # refuses an obstacle at the start
    check_stack(stack)
    recorded = folder / "follow.mcap"
    x, y, _ = loaded.laser.position.tolist()
    with atomic_write(recorded) as draft:
        problem = FollowedWalk(draft, stack, (x, y), seconds, view, console).run()
        if problem:
            console.print(problem, style="bold red")
        try:
            outcome, moments = read_following(draft, loaded)
        except RecordingError as error:  # files of an earlier run stay
            if problem:
                raise typer.Exit(1) from None
            raise RecordingError(str(error).replace(str(draft), str(recorded))) from None
    console.print(tour_table(write_tour(folder, loaded, outcome, moments)))
    console.print(f"written to {folder}: follow.mcap, tour.json, tour.png")
    console.print(f"to watch the run: quadvel view {recorded}", highlight=False)
    good = not (problem or outcome.fell or outcome.touched)
    if not (good or lockstep):
        console.print(LOCKSTEP_HINT)
    return good
