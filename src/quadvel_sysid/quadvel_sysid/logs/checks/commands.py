"""Check that joints are under position control: find commands that rest while the joint moves.

It compares spans of angle and command. `response` examines how the torque answers a command that
moves, and `channels` examines the recorded channels alone.
"""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.arrays import Array
from quadvel_description.name_list import format_names

from ..findings import Finding
from ..log import Log
from .channels import MOVING_SPAN_RAD, sample_rows
from .response import least_squares_residual, motion_regressors

MIN_SWING_RAD = 0.5
"""rad; smallest span of q that is checked; a drive that holds its joint yields less to a load."""
NOISE_SPAN_SHARE = 0.01
"""Share of the span of q, below which the span of q_des is noise; a wrong unit (57 degrees a radian)
makes 0.017.
"""
SPAN_PERCENTILES = (1.0, 99.0)
"""Percentiles of the rows between which a span is computed, since the first rows often hold another
value.
"""
MAX_HOLDING_ERROR = 0.3
"""A drive holds a joint if a PD law about the resting command leaves at most this share of its
torque.
"""
MIN_ANSWERED_SHARE = 0.5
"""Share of the torque left by speed, friction and offset that the angle explains at least if a drive
holds the joint.
"""


def constant_command(log: Log) -> Iterator[Finding | Log]:
    """Commands that never change on joints that move and that no drive holds in place.

    Args:
        log: The log to check.

    Yields:
        A refusal if all joints are concerned; else a warning, and the log with these joints
        invalid.
    """
    swings, asked = _span(log.q), _span(log.q_des)
    resting = (asked < np.maximum(MOVING_SPAN_RAD, NOISE_SPAN_SHARE * swings)) & (swings > MIN_SWING_RAD)
    if log.tau is None:
        # Without torque, a single joint may be moved by a load or by a torque command.
        resting &= resting.all()
    hit = np.array([bool(rests) and not _holds(log, j) for j, rests in enumerate(resting)])
    if not hit.any():
        return
    joints = log.joints_where(hit)
    values = sorted({f"{value:.3g}" for value in np.median(log.q_des, axis=0)[hit]})
    where = "all joints" if hit.all() else format_names(joints)
    text = f"q_des: never changes ({format_names(values)} on {where}) though q moves, so nothing follows a position"
    if log.tau_ff is not None and log.tau_ff[:, hit].any():
        text += ": the log is of torque commands (tau_ff)"
    if hit.all():
        yield Finding("refusal", "q_des", joints, f"{text}; expected the position commands of the drive")
    else:
        yield Finding("warning", "q_des", joints, f"{text}; left out there")
        yield attrs.evolve(log, valid=log.valid & ~hit)


def _span(angles: NDArray[np.floating]) -> Array:
    """Range (J,) of each column between two percentiles, rad."""
    return np.asarray(np.ptp(np.percentile(angles, SPAN_PERCENTILES, axis=0), axis=0))


def _holds(log: Log, j: int) -> bool:
    """Whether the torque of joint `j` pulls back to a resting command; false without torque."""
    # With the regressors of speed, friction and offset projected out of torque and angle:
    #     tau' = -kp q' + e
    #     answered = (tau' . q')^2 / (|tau'|^2 |q'|^2),   left = var(e) / var(tau)
    if log.tau is None:
        return False
    row = sample_rows(log)
    torque = np.asarray(log.tau[row, j], dtype=float)
    if log.tau_ff is not None:
        torque = torque - log.tau_ff[log.command_rows(log.t[row]), j]
    moved = np.asarray(motion_regressors(log.dq[row, j]), dtype=np.float64)
    residual, angle = (
        least_squares_residual(moved, np.asarray(x, dtype=float)) for x in (torque, log.q[row, j])
    )
    pull = float(residual @ angle)
    answered = pull**2 / ((residual @ residual) * (angle @ angle) + 1e-12)
    left = (1.0 - answered) * float(residual @ residual) / (len(row) * float(np.var(torque)) + 1e-12)
    return bool(pull < 0.0 and answered > MIN_ANSWERED_SHARE and left < MAX_HOLDING_ERROR)
