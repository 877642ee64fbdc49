"""Torque errors from states that are read at a wrong instant, against closed form and a simulated drive."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_sysid.data.signals import Samples
from quadvel_sysid.logs.log import Log
from quadvel_sysid.model.torque_model import Model
from quadvel_sysid.statistics.reading_error import CLOCK_ERROR_S, reading_errors

KP, KD = 30.0, 2.0


def _model(t: np.ndarray, q: np.ndarray, dq: np.ndarray, output_delay: float) -> Model:
    """The plain model of one joint that moves as given, commanded to stay at 0."""
    gains = {"kp": np.full(q.shape, KP), "kd": np.full(q.shape, KD)}
    valid = np.ones(q.shape, bool)
    log = Log("log", ("one_joint",), t, q, dq, t, np.zeros(q.shape), valid, tau=-KP * q - KD * dq, **gains)
    one = np.zeros(1, dtype=np.intp)
    return Model(Samples.of([log]), 0.0, np.ones((2, 1)), one, np.array([[0.002], [output_delay]]), one)


def test_at_constant_speed_it_is_that_of_the_angle() -> None:
    t = np.arange(0.0, 2.0, 0.002)
    model = _model(t, 0.8 * t[:, None], np.full((len(t), 1), 0.8), 0.001)
    found = reading_errors(model, model.samples.evaluated)
    assert found[0] == pytest.approx((KP * 0.8 * CLOCK_ERROR_S) ** 2 / 3.0, rel=1e-6)


@pytest.mark.parametrize("output_delay", [0.004, 0.010])
def test_speeds_whose_slope_jumps_between_rows_are_known_as_well_as_it_says(output_delay: float) -> None:
    """Accelerations that change once at a random instant between rows that are 20 ms apart."""
    rng, fine = np.random.default_rng(3), 0.0002
    level = (np.arange(300_000) + rng.integers(0, 100, 3001).repeat(100)[:300_000]) // 100
    ddq = rng.normal(0.0, 5.0, 3002)[level]
    dq = np.cumsum(ddq) * fine
    dq -= np.convolve(dq, np.full(5001, 1 / 5001), "same")  # stays near 0, and keeps its jumps of slope
    q = np.cumsum(dq) * fine
    rows = np.arange(10_000, 290_000, 100)
    model = _model(rows * fine, q[rows, None], dq[rows, None], output_delay)
    read = model.signals.dq[:, 0]
    true = np.mean((KD * (read - dq[rows - round(output_delay / fine)]))[1:] ** 2)
    by_clock = np.mean((KP * dq[rows]) ** 2 + (KD * 5.0) ** 2) * CLOCK_ERROR_S**2 / 3.0
    found = reading_errors(model, model.samples.evaluated)[0]
    assert found == pytest.approx(true + by_clock, rel=0.2)
