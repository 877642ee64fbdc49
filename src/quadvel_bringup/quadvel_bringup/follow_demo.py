"""`quadvel demo follow`: the robot follows a person through a simulated world, in real time and every node a process of its own,
or, as a tour of some kilometres, in one process and as fast as the machine allows.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from quadvel_eval.following.recorded import read_following
from quadvel_eval.following.tour_report import tour_table, write_tour
from quadvel_eval.output import replacing
from quadvel_sim.world import World

from .nodes import arguments, command
from .preflight import rehearse
from .recorded_run import RecordedRun
from .stack import Stack

FOLLOWED = {
    "/cmd_vel_follow": "geometry_msgs/msg/Twist",
    "/follow_planner/path": "nav_msgs/msg/Path",
    "/follow_planner/state": "std_msgs/msg/String",
    "/ground_truth/persons": "geometry_msgs/msg/PoseArray",
    "/person": "geometry_msgs/msg/PoseStamped",
    "/person/odometry": "nav_msgs/msg/Odometry",
    "/person_tracker/markers": "visualization_msgs/msg/MarkerArray",
    "/scan": "sensor_msgs/msg/LaserScan",
}


class FollowedWalk(RecordedRun):
    """Over `seconds` after the robot began to follow."""

    def __init__(
        self,
        recording: Path,
        stack: Stack,
        laser: tuple[float, float],
        seconds: float,
        view: bool,
        console: Console,
    ) -> None:
        """laser: where it is on the robot, x and y, m. view: with the operator's page."""
        place = dict(zip(("laser_x", "laser_y"), laser, strict=True))
        names = ("person_tracker", "follow_planner")
        followers = {name: command(name, arguments(name, place, stack.parameters)) for name in names}
        super().__init__(recording, {**stack.commands(view), **followers}, FOLLOWED, False, console, seconds)
        self._seconds, self._began = seconds, float("inf")

    def listen(self, node: Any) -> None:
        from std_msgs.msg import String

        node.create_subscription(String, "follow_planner/state", self._on_state, 10)

    def is_over(self, ended: Mapping[str, int]) -> bool:
        return not ended and time.monotonic() - self._began > self._seconds

    def _on_state(self, message: Any) -> None:
        state, words = message.data.split(": ", maxsplit=1)
        if state == "following" and self._began == float("inf"):
            self._began = time.monotonic()
        passed = max(time.monotonic() - self._began, 0.0)
        self._bar.update(self._task, completed=passed, description=words[:24])


def follow(folder: Path, world: str, seconds: float, view: bool, console: Console) -> bool:
    """Run, judge, write; whether the robot neither fell nor touched anything. view: with the operator's page."""
    stack, loaded = Stack(world=world), World.load(world)
    rehearse(stack)
    recorded = folder / "follow.mcap"
    x, y, _ = loaded.laser.position.tolist()
    with replacing(recorded) as draft:
        problem = FollowedWalk(draft, stack, (x, y), seconds, view, console).run()
    if problem:
        console.print(f"[bold red]{problem}")
    outcome, moments = read_following(recorded, loaded)
    console.print(tour_table(write_tour(folder, loaded, outcome, moments)))
    console.print(f"written to {folder}: follow.mcap, tour.json, tour.png")
    console.print(f"no video is drawn of it; to watch it: quadvel view {recorded}", highlight=False)
    return not (problem or outcome.fell or outcome.touched)
