"""Which of the delays that a log cannot tell apart are reported."""

import attrs
import numpy as np
import pytest
from simulated_joints import NAMES, parameters, record

from quadvel_actuator.identify.delays import fit_with_delays, in_steps
from quadvel_actuator.identify.identify import identify
from quadvel_actuator.identify.model import Model
from quadvel_actuator.identify.signals import Samples

JOINTS = NAMES[:2]
ONE = np.zeros(2, dtype=np.intp)


def _log(seconds, seed=0, **values):
    return record(attrs.evolve(parameters(**values), joints=JOINTS), 2, seconds, 1000, seed=seed)


def _fitted(log, input_delay, output_delay):
    samples = Samples([log])
    delays = np.full(2, input_delay), np.full(2, output_delay)
    model = Model(samples, 0.001, np.ones((2, 2)), np.array([ONE, ONE]), *delays, ONE)
    return fit_with_delays(model, samples.judged, 20), samples.judged


def test_a_log_that_tells_little_is_read_as_a_drive_that_works_in_whole_steps():
    fitted, rows = _fitted(_log(2.0), 0.007, 0.001)
    assert abs(fitted.output_delay[0] - 0.001) > 1e-5
    told = in_steps(fitted, rows)
    np.testing.assert_allclose([told.input_delay[0], told.output_delay[0]], [0.007, 0.001], atol=1e-9)


def test_delays_that_a_log_tells_clearly_stay_between_the_steps():
    fitted, rows = _fitted(_log(5.0, input_delay=0.0066, output_delay=0.0024, noise=1e-3), 0.0066, 0.0024)
    assert in_steps(fitted, rows) is fitted


@pytest.mark.parametrize("heldout", [False, True])
def test_values_come_from_every_row_but_those_of_a_log_that_is_held_out(heldout):
    log = _log(3.0, seed=4)
    found = identify([log], [_log(3.0, seed=5)] if heldout else []).report["before"]
    whole, _ = _fitted(log, 0.007, 0.001)
    told = in_steps(whole, whole.samples.judged)
    assert found["delta_kp"] == pytest.approx((told.gains[0, 0] - 1.0) * 30.0, abs=0.002)
