"""Latch of the stop that a fault of level STANCE causes. Knows no ROS."""

from __future__ import annotations

from collections.abc import Iterable

import attrs

from .guard import Finding


@attrs.define
class StopLatch:
    """Keeps a robot stopped from the first fault of level STANCE until the operator releases it.

    Attributes:
        cause: The fault that stopped the robot; None if the latch is open.
        since: Time of that fault, s, on the clock of the states.
    """

    cause: Finding | None = None
    since: float = 0.0

    @property
    def sentence(self) -> str:
        """Description of the cause; "" if the latch is open."""
        return self.cause.sentence if self.cause else ""

    def close(self, cause: Finding, now: float) -> None:
        """Stop the robot.

        Args:
            cause: The fault.
            now: Time, s, on the clock of the states.
        """
        self.cause, self.since = cause, now

    def open(self) -> None:
        """Release the robot."""
        self.cause = None

    def persists(self, findings: Iterable[Finding]) -> bool:
        """Return whether the latch is closed and its cause is still found.

        Args:
            findings: Present faults.

        Returns:
            True if the operator must not release the robot.
        """
        return self.cause is not None and any(found.name == self.cause.name for found in findings)
