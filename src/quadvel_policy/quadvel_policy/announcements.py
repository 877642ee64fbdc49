"""What the operator is told of the supervisor: a sentence for each change, none while nothing changes. Knows no ROS."""

from __future__ import annotations

from collections.abc import Iterator

from .supervisor import FOLLOWING, Supervisor


class Announcements:
    """Remembers what was told; the sentences are for a log."""

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor
        self._mode: tuple[str, str] | None = None
        self._refusal: str | None = None

    def now(self) -> Iterator[tuple[bool, str]]:
        """After each tick and request: whether it is a fault, and the sentence."""
        mode, reason = self._supervisor.mode, self._supervisor.reason
        if (mode, reason) != self._mode:
            self._mode = mode, reason
            way_out = "; the joints are damped until passive is requested, then stand_up"
            yield mode == "fault", f"{mode}: {reason}{way_out if mode == 'fault' else ''}"
        if mode not in FOLLOWING:
            self._refusal = None
        elif self._refusal != "" and not self._supervisor.walk_refusal:
            self._refusal = ""
            yield False, "ready: a velocity makes it walk"

    def waiting(self) -> Iterator[str]:
        """Now and then: why a standing robot follows no velocity, once for each reason."""
        refusal = self._supervisor.walk_refusal
        if self._supervisor.mode in FOLLOWING and refusal not in ("", self._refusal):
            self._refusal = refusal
            yield f"follows no velocity: {refusal}"
