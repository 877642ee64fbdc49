"""Is a joint under position control at all? A command that never changes while the joint moves says that it is not."""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np
from numpy.typing import NDArray

from .channels import REACHES, names, rows_of
from .findings import Finding, some
from .log import Log
from .response import motion

SWINGS = 0.5
"""rad, span of q from which a joint whose command rests is looked at: less may be what a drive gives way to a load."""
HARDLY = 0.01
"""Share of the span of q below which that of q_des is noise; a unit mistaken (57 degrees a radian) makes 0.017 of it."""
ALL_BUT = (1.0, 99.0)
"""Per cent of the rows between which a span is taken: the first rows often hold another value."""
HELD = 0.3
"""Share of the torque that a PD law about a resting command, with friction and an offset, leaves at most."""
ANSWERED = 0.5
"""Share of what speed, friction and offset leave that the angle explains at least where a drive holds it."""


def constant(log: Log) -> Iterator[Finding | Log]:
    """Commands that never change on joints that move and that no drive holds there: nothing follows a position."""
    swings, asked = _span(log.q), _span(log.q_des)
    resting = (asked < np.maximum(REACHES, HARDLY * swings)) & (swings > SWINGS)
    if log.tau is None:
        resting &= (
            resting.all()
        )  # what moves a single joint, a load or a torque, the motion alone does not show
    hit = np.array([bool(rests) and not _holds(log, j) for j, rests in enumerate(resting)])
    if not hit.any():
        return
    joints = names(log, hit)
    values = sorted({f"{value:.3g}" for value in np.median(log.q_des, axis=0)[hit]})
    where = "all joints" if hit.all() else some(joints)
    text = f"q_des: never changes ({some(values)} on {where}) though q moves, so nothing follows a position"
    if log.tau_ff is not None and log.tau_ff[:, hit].any():
        text += ": the log is of torque commands (tau_ff)"
    if hit.all():
        yield Finding("refusal", "q_des", joints, f"{text}; expected the position commands of the drive")
    else:
        yield Finding("warning", "q_des", joints, f"{text}; left out there")
        yield attrs.evolve(log, valid=log.valid & ~hit)


def _span(angles: NDArray[np.floating]) -> NDArray[np.float64]:
    """How far each column goes, rad, but for a few rows."""
    return np.asarray(np.ptp(np.percentile(angles, ALL_BUT, axis=0), axis=0))


def _holds(log: Log, j: int) -> bool:
    """Does the torque of joint `j` pull back to a command that rests? Not known without torque: then no."""
    if log.tau is None:
        return False
    row = rows_of(log)
    torque = np.asarray(log.tau[row, j], dtype=float)
    if log.tau_ff is not None:
        torque = torque - log.tau_ff[log.command_rows(log.t[row]), j]
    moved = np.asarray(motion(log.dq[row, j]), dtype=np.float64)
    rest, angle = (_residual(moved, np.asarray(x, dtype=float)) for x in (torque, log.q[row, j]))
    pull = float(rest @ angle)
    answered = pull**2 / ((rest @ rest) * (angle @ angle) + 1e-12)
    left = (1.0 - answered) * float(rest @ rest) / (len(row) * float(np.var(torque)) + 1e-12)
    return bool(pull < 0.0 and answered > ANSWERED and left < HELD)


def _residual(signals: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """What a sum of `signals` leaves of `x`."""
    return np.asarray(x - signals @ np.linalg.lstsq(signals, x, rcond=1e-9)[0])
