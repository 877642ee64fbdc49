"""What an identification computes on: logs that were looked at and fit together, of long ones the pieces spread over them."""

from __future__ import annotations

from collections.abc import Callable

import attrs

from .logs.dataset import Dataset
from .logs.excerpts import cut_excerpts
from .logs.findings import Finding
from .logs.log import Log
from .motion import Body, imply_torque

Progress = Callable[[float, str], None]
"""Told now and then which share is done, and what is done next."""

VALUES = 60_000
"""Of torque that are looked at, of all logs and joints."""


@attrs.frozen(eq=False)
class IdentificationData:
    """Logs, of long ones pieces that hold no more than they show, so that these can be let go of."""

    logs: tuple[Log, ...]
    fitted: int
    """of them, the first ones; all where no log is there to judge on"""
    body: Body | None
    """that the joints carry, where the torque is what their motion implies"""
    findings: tuple[tuple[str, Finding], ...]
    """by log"""

    @property
    def heldout(self) -> bool:
        """Are there logs to judge on?"""
        return self.fitted < len(self.logs)


def prepare(
    data: Dataset,
    values: int = VALUES,
    progress: Progress = lambda share, text: None,
) -> IdentificationData:
    """Of the logs to fit and to judge on as many `values` of torque in all. Raises LogError where they can't be used together."""
    logs, train = data.logs, len(data.fitted)
    body = None
    if logs[0].tau is None:
        progress(0.01, "the torque that the motion implies")
        first, body = imply_torque(logs[0])
        logs = [first, *(imply_torque(log, body)[0] for log in logs[1:])]
    rows = values // (len(logs) * len(logs[0].joints))
    # One script may have led all logs: what judges comes from other instants of it than what is fitted.
    parts = [cut_excerpts(log, rows * log.period, between=k >= train) for k, log in enumerate(logs)]
    chosen = tuple(log for part in parts for log in part)
    fitted = sum(len(part) for part in parts[:train]) if data.heldout else len(chosen)
    return IdentificationData(chosen, fitted, body, data.findings)
