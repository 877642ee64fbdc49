"""Log of the supervisor for the operator: one sentence for each change. Knows no ROS.

The controller node writes the lines to the ROS log; the reasons come from the supervisor.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

from .guard import Level
from .supervisor import Supervisor
from .transitions import VELOCITY_MODES

REPEAT_AFTER_S = 5.0
"""s without a finding before the same finding is logged again."""


class OperatorLog:
    """Generates log sentences from changes of the supervisor."""

    def __init__(self, supervisor: Supervisor, clock: Callable[[], float] = time.monotonic) -> None:
        """Create a log.

        Args:
            supervisor: The supervisor to observe.
            clock: A steady clock, s.
        """
        self._supervisor = supervisor
        self._mode: tuple[str, str] | None = None
        self._refusal: str | None = None
        self._last_seen: dict[str, float] = {}  # by name: time of the last occurrence, s
        self._clock = clock

    def changes(self) -> Iterator[tuple[bool, str]]:
        """Generate the sentences about changes; to be called after each tick and request.

        Yields:
            Whether it is a fault, and the sentence.
        """
        mode, reason = self._supervisor.mode, self._supervisor.reason
        if (mode, reason) != self._mode:
            self._mode = mode, reason
            yield bool(self._supervisor.fault), f"{mode}: {reason}{self._recovery_hint()}"
        yield from self._new_findings()
        if mode not in VELOCITY_MODES:
            self._refusal = None
        elif self._refusal != "" and not self._supervisor.walk_refusal:
            self._refusal = ""
            yield False, "ready; waiting for a velocity command"

    def _recovery_hint(self) -> str:
        """Return how the operator recovers from the present fault."""
        if self._supervisor.mode == "fault":
            return "; the joints are damped until passive is requested, then stand_up"
        if self._supervisor.fault and self._supervisor.mode == "walk":
            return "; the robot brakes"
        return "; it stands until stance is requested" if self._supervisor.fault else ""

    def _new_findings(self) -> Iterator[tuple[bool, str]]:
        """Yield findings that do not stop the robot, each again only after REPEAT_AFTER_S without it."""
        for finding in self._supervisor.findings:
            if finding.level > Level.LIMIT:
                continue
            now = self._clock()
            if now - self._last_seen.get(finding.name, -math.inf) > REPEAT_AFTER_S:
                yield False, finding.sentence
            self._last_seen[finding.name] = now

    def walk_refusals(self) -> Iterator[str]:
        """Generate the reason why a standing robot does not follow a velocity, once per reason; call it at 1 Hz.

        Yields:
            The sentence.
        """
        refusal = self._supervisor.walk_refusal
        if self._supervisor.mode in VELOCITY_MODES and refusal not in ("", self._refusal):
            self._refusal = refusal
            yield f"follows no velocity: {refusal}"
