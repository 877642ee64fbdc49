"""Torque error that remains with the true model, because a log does not show when the drive reads q and dq.

A drive computes its torque from the states at its own instants. The log shows the states at its rows,
and the instants only roughly. An effect that explains no more than that may be an artefact.
"""

from __future__ import annotations

import numpy as np

from quadvel_description.arrays import Array, Bools

from ..data.log_signals import LogSignals
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
    #     (g_p kp dq + g_d kd ddq) e,   var e = clock error^2 / 3.
    # Jitter of the stamps adds to e, but independently in each row: no effect can make up for that.
    s = model.signals
    kp, kd = model.gains[0] * s.kp, model.gains[1] * s.kd
    slope = kp * s.dq + kd * s.ddq
    squared = slope**2 * CLOCK_ERROR_S**2 / 3.0 + kd**2 * _interpolation_error(model)
    found: Array = np.sum(squared, axis=0, where=rows) / np.maximum(rows.sum(axis=0), 1)
    return found


def _interpolation_error(model: Model) -> Array:
    """Mean squared error (N, J), rad^2/s^2, of dq that is interpolated between two rows."""
    # Let dq have a new, independent slope from a random instant of each interval of length h on, and let
    # k^2 be the mean square of the change. At the position s, with a = 2 s (1 - s) (`averaging`), dq is
    #     between two rows, by a straight line:     wrong by (k h)^2 a^2 / 12,
    #     by the parabola of `speed_bend`:          wrong by (k h)^2 a^2 (8 - 15 a) / 240;
    #     at a row left out, from the rows next to it:  5 (k h)^2 / 48 and (k h)^2 / 240.
    # The latter are measured, with noise of dq on top; their ratios to the former do not depend on k.
    series, a = model.samples.sources.series, model.signals.averaging
    weights = [len(one.t) for one in series]
    straight, curved = np.average([_left_out(one) for one in series], axis=0, weights=weights)
    error: Array = a**2 * (0.8 * straight + (8.0 - 15.0 * a) * curved)
    return error


def _left_out(series: LogSignals) -> tuple[Array, Array]:
    """Errors (J,) of lines and of parabolas at rows that are left out, each 0 where it is not used."""
    straight, curved = series.left_out_speed_errors
    return np.where(series.curved, 0.0, straight), np.where(series.curved, curved, 0.0)
