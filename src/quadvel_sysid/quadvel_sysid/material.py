"""What an identification computes on: logs that were looked at and fit together, of long ones the pieces spread over them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs
import numpy as np

from .logs.dataset import Dataset
from .logs.excerpts import Piece, pieces
from .logs.findings import Finding
from .logs.log import Log
from .motion import Body, implied
from .signals import Array

Progress = Callable[[float, str], None]
"""Told now and then which share is done, and what is done next."""

VALUES = 60_000
"""Of torque that are looked at, of all logs and joints."""


@attrs.frozen(eq=False)
class Material:
    """Pieces that hold no more of their logs than they show: a long log can be let go of."""

    pieces: tuple[Piece, ...]
    fitted: int
    """of the pieces, the first ones; all where no log is there to judge on"""
    kp: Array | None
    """(1,) N m/rad, of logs that hold none"""
    kd: Array | None
    """(1,) N m s/rad, likewise"""
    body: Body | None
    """that the joints carry, where the torque is what their motion implies"""
    findings: tuple[tuple[str, Finding], ...]
    """by log"""

    @property
    def heldout(self) -> bool:
        """Are there logs to judge on?"""
        return self.fitted < len(self.pieces)


def gathered(
    data: Dataset,
    gains: tuple[float, float] | None = None,
    values: int = VALUES,
    progress: Progress = lambda share, text: None,
) -> Material:
    """Of the logs to fit and to judge on as many `values` of torque in all. Raises LogError where they can't be used together."""
    logs, train = data.logs, len(data.fitted)
    kp, kd = (np.array([gain]) for gain in gains) if gains else (None, None)
    body = None
    if logs[0].tau is None:
        progress(0.01, "the torque that the motion implies")
        logs, body = _moving(logs, kp, kd)
    rows = values // (len(logs) * len(logs[0].joints))
    # One script may have led all logs: what judges comes from other instants of it than what is fitted.
    parts = [pieces(log, rows * log.period, between=k >= train) for k, log in enumerate(logs)]
    chosen = tuple(piece for part in parts for piece in part)
    fitted = sum(len(part) for part in parts[:train]) if data.heldout else len(chosen)
    return Material(chosen, fitted, kp, kd, body, data.findings)


def _moving(logs: Sequence[Log], kp: Array | None, kd: Array | None) -> tuple[list[Log], Body]:
    """The logs with the torque that their motion implies, and the body that they carry, from the first one."""
    first, body = implied(logs[0], kp, kd)
    return [first, *(implied(log, kp, kd, body)[0] for log in logs[1:])], body
