"""Which of the delays that a log cannot tell apart are reported."""

import attrs
import numpy as np
import pytest
from simulated_joints import NAMES, parameters, record

from quadvel_actuator import ActuatorModel
from quadvel_sysid.engine.delays import fit_with_delays, in_steps
from quadvel_sysid.engine.identify import identify
from quadvel_sysid.engine.model import Model
from quadvel_sysid.engine.signals import Samples
from quadvel_sysid.engine.stepped import stepped_delays

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


@pytest.mark.parametrize("window", [0.0, 0.001])
def test_a_running_model_does_not_blur_what_the_drive_does_not(window):
    """A fit says the same with an output delay between two steps, which averages the noise of encoders, too."""
    drive, log = _quiet(0.007, 0.001)
    fitted = np.array([0.00666, 0.00133])
    told = stepped_delays(_model(drive, log, window, fitted), None, log.valid)
    assert told == pytest.approx((0.007, 0.001), abs=3e-5)
    assert _run(drive, log, told) < 0.01 * _run(drive, log, fitted)


def test_a_running_model_waits_between_the_steps_where_the_drive_does():
    drive, log = _quiet(0.0066, 0.0024)
    told = stepped_delays(_model(drive, log, 0.001, np.array([0.0066, 0.0024])), None, log.valid)
    assert told == pytest.approx((0.0066, 0.0024), abs=3e-5)


def _quiet(*delays):
    """A drive, and a log of it with hardly any noise."""
    truth = parameters(input_delay=delays[0], output_delay=delays[1], noise=1e-6)
    drive = attrs.evolve(truth, joints=JOINTS)
    return drive, record(drive, 2, 3.0)


def _model(drive, log, window, delays):
    """With the gains of the drive."""
    gains = np.array([1.0 + drive.delta_kp / drive.kp_ref, 1.0 + drive.delta_kd / drive.kd_ref])
    each = (np.full(2, one) for one in delays)
    return Model(Samples([log]), window, gains[:, None] * np.ones(2), np.array([ONE, ONE]), *each, ONE)


def _run(drive, log, delays):
    """Mean squared torque error of the drive as it runs with these delays, past the beginning."""
    pair = attrs.evolve(drive.pairs[0], input_delay_s=delays[0], output_delay_s=delays[1])
    model = ActuatorModel(attrs.evolve(drive, pairs=(pair,), torque_noise=0.0), (2,), 0.001)
    rows = zip(log.q, log.dq, log.q_des, strict=True)
    torque = np.array([model.step(q, dq, q_des, 30.0, 0.5) for q, dq, q_des in rows])
    return np.mean((log.tau - torque)[100:] ** 2)
