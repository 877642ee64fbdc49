"""What an identification computes on: logs that were looked at and fit together, of long ones the pieces spread over them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs
import numpy as np

from .logs.excerpts import Piece, pieces
from .logs.findings import Finding
from .logs.inspect import inspect
from .logs.log import Log, LogError
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
    train: Sequence[Log],
    heldout: Sequence[Log] = (),
    gains: tuple[float, float] | None = None,
    values: int = VALUES,
    progress: Progress = lambda share, text: None,
) -> Material:
    """Of the logs to fit and to judge on as many `values` of torque in all. Raises LogError where they can't be used together."""
    logs, findings = _checked([*train, *heldout])
    kp, kd = (np.array([gain]) for gain in gains) if gains else (None, None)
    body = None
    if logs[0].tau is None:
        progress(0.01, "the torque that the motion implies")
        logs, body = _moving(logs, kp, kd)
    rows = values // (len(logs) * len(logs[0].joints))
    # One script may have led all logs: what judges comes from other instants of it than what is fitted.
    parts = [pieces(log, rows * log.period, between=k >= len(train)) for k, log in enumerate(logs)]
    chosen = tuple(piece for part in parts for piece in part)
    fitted = sum(len(part) for part in parts[: len(train)]) if heldout else len(chosen)
    return Material(chosen, fitted, kp, kd, body, tuple(findings))


def _checked(logs: Sequence[Log]) -> tuple[list[Log], list[tuple[str, Finding]]]:
    """The logs, `valid` narrowed to what a PD model can explain, and what was seen; refuses what cannot be used."""
    inspected = [inspect(log) for log in logs]
    for one in inspected:
        one.raise_refusal()
        if (one.log.tau is None) != (logs[0].tau is None):
            raise LogError(f"{one.log.name}: tau: expected it in every log or in none, as in {logs[0].name}")
        if one.log.joints != logs[0].joints:
            raise LogError(
                f"{one.log.name}: joint_names: found {', '.join(one.log.joints)}, "
                f"expected those of {logs[0].name}: {', '.join(logs[0].joints)}"
            )
    return [one.log for one in inspected], [(one.log.name, f) for one in inspected for f in one.findings]


def _moving(logs: Sequence[Log], kp: Array | None, kd: Array | None) -> tuple[list[Log], Body]:
    """The logs with the torque that their motion implies, and the body that they carry, from the first one."""
    first, body = implied(logs[0], kp, kd)
    return [first, *(implied(log, kp, kd, body)[0] for log in logs[1:])], body
