"""Torque error that remains with the true model, because a log does not show when the drive reads q and dq.

A drive computes its torque from the states at its own instants. The log shows the states at its rows,
and the instants only roughly. An effect that explains no more than that may be an artefact.
"""

from __future__ import annotations

import numpy as np

from quadvel_description.arrays import Array, Bools

from ..model.torque_model import Model

CLOCK_ERROR_S = 0.25e-3
"""Maximum error of the drive's instants, s: a log does not record the drive's clock."""


def reading_errors(model: Model, rows: Bools) -> Array:
    """Estimate the torque error that follows from unknown instants and from the interpolation of dq.

    Args:
        model: The plain model.
        rows: Samples to average over, (N, J) bool.

    Returns:
        Mean squared error of each joint, (J,), N^2 m^2.
    """
    # A state that is read e seconds early changes the torque of the PD law by
    #     (g_p kp dq + g_d kd ddq) e,   var e = clock error^2 / 3 + variance of the stamps.
    s, samples = model.signals, model.samples
    kp, kd = model.gains[0] * s.kp, model.gains[1] * s.kd
    slope = kp * s.dq + kd * s.ddq
    steps = samples.dt[~samples.start]
    timing = CLOCK_ERROR_S**2 / 3.0 + 0.5 * float(np.var(steps))
    squared = slope**2 * timing + kd**2 * _interpolation_error(model)
    found: Array = np.sum(squared, axis=0, where=rows) / np.maximum(rows.sum(axis=0), 1)
    return found


def _interpolation_error(model: Model) -> Array:
    """Mean squared error (N, J), rad^2/s^2, of dq that is interpolated between two rows."""
    # Let dq have a new, independent slope from a random instant of each interval of length h on, and let
    # k^2 be the mean square of the change. A straight line between two rows then has the mean squared
    # error (k h)^2 s^2 (1 - s)^2 / 3 at the position s. A line over two intervals shows k: its error e at
    # the row between them has mean e^2 = 5 (k h)^2 / 48, to which noise of dq adds. So the error is at
    # most 16 / 5 s^2 (1 - s)^2 mean e^2, where `averaging` is 2 s (1 - s).
    samples = model.samples
    at_rows = samples.at(0.0, 0.0, 0.0).dq
    inner = ~(samples.start[1:-1] | samples.start[2:])
    bend = (at_rows[1:-1] - 0.5 * (at_rows[:-2] + at_rows[2:]))[inner]
    error: Array = 0.8 * model.signals.averaging**2 * np.mean(bend**2, axis=0)
    return error
