"""When a node of the control loop runs: before others, and on which cores. Needs Linux, not ROS."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import attrs

HIGHEST = 99
THREADS = Path("/proc/self/task")


@attrs.frozen(kw_only=True, slots=False)  # to stand beside another base
class Scheduling:
    """Parameters that a node of the control loop adds to its own, and what puts them into force.

    Raises ValueError where one of them is malformed.
    """

    realtime_priority: int = attrs.field(
        default=50,
        metadata={
            "description": "priority of the node's threads among real-time ones (SCHED_FIFO), 1 to 99; 0: none"
        },
    )
    cpus: str = attrs.field(
        default="", metadata={"description": "cores that the node may use, such as 2,3; empty: any"}
    )

    @realtime_priority.validator
    def _is_priority(self, attribute: object, value: int) -> None:
        if not 0 <= value <= HIGHEST:
            raise ValueError(f"realtime_priority is {value}, expected 0 to {HIGHEST}")

    @cpus.validator
    def _are_cores(self, attribute: object, value: str) -> None:
        there = os.sched_getaffinity(0)
        if value and not all(word.strip().isdecimal() and int(word) in there for word in value.split(",")):
            raise ValueError(f"cpus is {value!r}, expected some of {','.join(map(str, sorted(there)))}")

    def apply(self, say: Callable[[str], object]) -> None:
        """To all threads of this process, and those that they start; where the system refuses, `say` why."""
        threads = [int(thread.name) for thread in THREADS.iterdir()]
        for thread in threads if self.cpus else ():
            os.sched_setaffinity(thread, {int(word) for word in self.cpus.split(",")})
        try:
            for thread in threads if self.realtime_priority else ():
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(self.realtime_priority))
        except PermissionError:
            say(
                "runs without real-time priority: the limit rtprio of this user or container does not allow it"
            )
