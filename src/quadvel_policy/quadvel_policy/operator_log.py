"""What the operator is told of the supervisor: a sentence for each change, none while nothing changes. Knows no ROS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

from .guard import Level
from .supervisor import POSTURE_AFTER, Supervisor

AGAIN = 5.0
"""s for which something has to be right before it is told again that it is wrong"""


class OperatorLog:
    """Remembers what was told; the sentences are for a log."""

    def __init__(self, supervisor: Supervisor, clock: Callable[[], float] = time.monotonic) -> None:
        self._supervisor = supervisor
        self._mode: tuple[str, str] | None = None
        self._refusal: str | None = None
        self._findings: dict[str, float] = {}  # by name: when it was told last, s
        self._clock = clock

    def now(self) -> Iterator[tuple[bool, str]]:
        """After each tick and request: whether it is a fault, and the sentence."""
        mode, reason = self._supervisor.mode, self._supervisor.reason
        if (mode, reason) != self._mode:
            self._mode = mode, reason
            yield bool(self._supervisor.fault), f"{mode}: {reason}{self._way_out()}"
        yield from self._new_findings()
        if mode not in POSTURE_AFTER:
            self._refusal = None
        elif self._refusal != "" and not self._supervisor.walk_refusal:
            self._refusal = ""
            yield False, "ready; waiting for a velocity command"

    def _way_out(self) -> str:
        if self._supervisor.mode == "fault":
            return "; the joints are damped until passive is requested, then stand_up"
        if self._supervisor.fault and self._supervisor.mode == "walk":
            return "; the robot brakes"
        return "; it stands until stance is requested" if self._supervisor.fault else ""

    def _new_findings(self) -> Iterator[tuple[bool, str]]:
        """What is wrong without stopping the robot, each kind once in a while."""
        for finding in self._supervisor.findings:
            if finding.level > Level.LIMIT:
                continue
            now = self._clock()
            if now - self._findings.get(finding.name, -math.inf) > AGAIN:
                yield False, finding.sentence
            self._findings[finding.name] = now

    def waiting(self) -> Iterator[str]:
        """Now and then: why a standing robot follows no velocity, once for each reason."""
        refusal = self._supervisor.walk_refusal
        if self._supervisor.mode in POSTURE_AFTER and refusal not in ("", self._refusal):
            self._refusal = refusal
            yield f"follows no velocity: {refusal}"
