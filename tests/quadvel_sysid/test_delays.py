"""Choice among delays that a log cannot resolve."""

import attrs
import numpy as np
import pytest

from quadvel_actuator import ActuatorModel
from quadvel_actuator.effects.dynamics import Armature, TimestampSkew
from quadvel_sysid.data.plain_model import fit_eam
from quadvel_sysid.data.signals import Samples
from quadvel_sysid.data.split import DataSplit
from quadvel_sysid.identify import identify
from quadvel_sysid.logs.log import Log
from quadvel_sysid.model.applied_effect import AppliedEffect
from quadvel_sysid.model.delays import central_equivalent_delay, quantised_delays, running_delays
from quadvel_sysid.model.fit import fit, fit_delay_profile, fit_delay_splits, squared_error
from quadvel_sysid.model.torque_model import Model
from quadvel_sysid.search.effect_candidates.dynamics import ArmatureCandidate, TimestampSkewCandidate
from quadvel_sysid.statistics.confidence import intervals
from tests.quadvel_sysid.simulated_joints import NAMES, parameters, record

JOINTS = NAMES[:2]
ONE = np.zeros(2, dtype=np.intp)


def _log(seconds, seed=0, **values):
    return record(attrs.evolve(parameters(**values), joints=JOINTS), 2, seconds, 1000, seed=seed)


def _fitted(log, input_delay, output_delay):
    samples = Samples.of([log])
    delays = np.repeat([[input_delay], [output_delay]], 2, axis=1)
    model = Model(samples, 0.001, np.ones((2, 2)), ONE, delays, ONE)
    return fit(model, samples.evaluated, 20), samples.evaluated


def test_uncertain_delays_are_rounded_to_whole_steps():
    fitted, rows = _fitted(_log(2.0), 0.007, 0.001)
    assert abs(fitted.delays[1, 0] - 0.001) > 1e-5
    rounded = quantised_delays(fitted, rows)
    np.testing.assert_allclose(rounded.delays[:, 0], [0.007, 0.001], atol=1e-9)


def test_well_determined_delays_stay_between_steps():
    fitted, rows = _fitted(_log(5.0, input_delay=0.0066, output_delay=0.0024, noise=1e-3), 0.0066, 0.0024)
    assert quantised_delays(fitted, rows) is fitted


@pytest.mark.parametrize("heldout", [False, True])
def test_reported_values_are_those_of_the_written_model_which_no_reported_row_fitted(heldout):
    log = _log(3.0, seed=4)
    found = identify([log], [_log(3.0, seed=5)] if heldout else [])
    whole, rows = _fitted(log, 0.007, 0.001)
    rows = rows & (heldout | (np.floor(whole.samples.t / 0.2) % 5 != 4))[:, None]
    rounded = quantised_delays(fit(whole, rows), rows)
    deviation = (rounded.gains[0, 0] - 1.0) * 30.0
    assert found.report["before"]["delta_kp"] == pytest.approx(deviation, abs=0.004)
    assert found.parameters.delta_kp == found.report["after"]["delta_kp"]


@pytest.mark.parametrize("window", [0.0, 0.001])
def test_a_running_model_does_not_smooth_the_commands_twice(window):
    """An output delay between two steps fits equally well, and averages encoder noise too."""
    drive, log = _quiet(0.007, 0.001)
    fitted = np.array([0.00666, 0.00133])
    delays = running_delays(_model(drive, log, window, fitted), log.valid)
    assert delays == pytest.approx((0.007, 0.001), abs=3e-5)
    assert _run(drive, log, delays) < 0.01 * _run(drive, log, fitted)


def test_a_running_model_keeps_the_drive_s_delay_between_steps():
    drive, log = _quiet(0.0066, 0.0024)
    delays = running_delays(_model(drive, log, 0.001, np.array([0.0066, 0.0024])), log.valid)
    assert delays == pytest.approx((0.0066, 0.0024), abs=3e-5)


def _quiet(*delays):
    """A drive, and its log with little noise."""
    truth = parameters(input_delay=delays[0], output_delay=delays[1], noise=1e-6)
    drive = attrs.evolve(truth, joints=JOINTS)
    return drive, record(drive, 2, 3.0)


def _model(drive, log, window, delays):
    """A model with the gains of the drive."""
    gains = np.array([1.0 + drive.delta_kp / drive.kp_ref, 1.0 + drive.delta_kd / drive.kd_ref])
    each = np.repeat(np.asarray(delays)[:, None], 2, axis=1)
    return Model(Samples.of([log]), window, gains[:, None] * np.ones(2), ONE, each, ONE)


def _run(drive, log, delays):
    """Mean squared torque error of the running drive with these delays, after the first 0.1 s."""
    pair = attrs.evolve(drive.pairs[0], input_delay_s=delays[0], output_delay_s=delays[1])
    model = ActuatorModel(attrs.evolve(drive, pairs=(pair,), torque_noise=0.0), (2,), 0.001)
    rows = zip(log.q, log.dq, log.q_des, strict=True)
    torque = np.array([model.step(q, dq, q_des, 30.0, 0.5) for q, dq, q_des in rows])
    return np.mean((log.tau - torque)[100:] ** 2)


def test_a_fit_on_a_grid_of_stamps_predicts_commands_between_its_rows():
    """With rows and commands on one grid, any input delay above 6 ms fits delays of 7 and 1 ms."""
    fitted, judged = (_driven(0.001, 0.001, 1), _driven(0.001, 0.00525, 2))
    report = identify([fitted], [judged]).report
    assert report["before"]["input_delay_ms"] == pytest.approx(7.0, abs=0.2)
    assert report["before"]["heldout_mse"] < 1.1 * 0.04


def _driven(row, command, seed):
    """Log of a drive with delays of 7 and 1 ms: a row every `row` s, a command every `command` s."""
    t, rng = np.arange(round(3.0 / row)) * row, np.random.default_rng(seed)
    sent = np.round(np.arange(0.0, 3.0, command) / 0.00025) * 0.00025
    phase = np.array([0.0, 1.0])

    def q(at):
        return 0.3 * np.sin(2 * np.pi * 3.0 * at[:, None] + phase)

    def dq(at):
        return 0.3 * 2 * np.pi * 3.0 * np.cos(2 * np.pi * 3.0 * at[:, None] + phase)

    wide = rng.uniform(-0.1, 0.1, (len(sent), 2)) if command > row else 0.0
    q_des = q(sent) + 0.2 * np.sin(2 * np.pi * 5.0 * sent[:, None]) + wide
    newest = np.maximum(np.searchsorted(sent, t - 0.008 + 1e-9, side="right") - 1, 0)
    tau = 29.0 * (q_des[newest] - q(t - 0.001)) - 0.48 * dq(t - 0.001)
    tau += 0.2 * rng.standard_normal(tau.shape)
    gains = {"kp": np.full(q_des.shape, 30.0), "kd": np.full(q_des.shape, 0.5)}
    return Log("grid", NAMES[:2], t, q(t), dq(t), sent, q_des, np.ones(tau.shape, bool), tau=tau, **gains)


def test_the_middle_of_the_equivalent_delays_on_a_grid_is_chosen():
    """The drive's delay of 7 ms cannot be distinguished from any above 6 ms."""
    log = _driven(0.001, 0.001, 1)
    samples = Samples.of([log])
    eam = fit_eam(samples, samples.evaluated)
    delays = np.stack([eam.input_delay, eam.output_delay])
    model = Model(samples, eam.window, eam.gains, ONE, delays, ONE)
    assert eam.output_delay[0] == pytest.approx(0.001, abs=2e-4)
    assert central_equivalent_delay(model, samples.evaluated).delays[0, 0] == pytest.approx(0.0065, abs=1e-4)


def test_averaging_of_encoder_noise_does_not_attract_the_output_delay():
    """Halfway between two rows, interpolation halves the noise of q and dq, which the drive did not see."""
    quiet, rng = _driven(0.004, 0.0205, 3), np.random.default_rng(4)
    tau = quiet.tau - 0.15 * rng.standard_normal(quiet.tau.shape)
    log = attrs.evolve(quiet, dq=quiet.dq + 0.3 * rng.standard_normal(quiet.dq.shape), tau=tau)
    gains = np.repeat([[29.0 / 30.0], [0.48 / 0.5]], 2, axis=1)
    on_rows = np.repeat([[0.008], [0.0]], 2, axis=1)
    model = Model(Samples.of([log]), 0.0, gains, ONE, on_rows, ONE)
    halfway = model.with_delays(np.repeat([[0.006], [0.002]], 2, axis=1))
    assert model.averaged_noise().max() < 1e-9
    assert halfway.averaged_noise()[5:].mean() == pytest.approx(0.5 * (0.48 * 0.3) ** 2, rel=0.15)


def test_effects_that_filter_encoder_noise_are_compared_as_if_they_did_not():
    """Late speeds and an inertia of kd times that time predict dq from its neighbours."""
    quiet, rng, late = _driven(0.004, 0.0205, 3), np.random.default_rng(4), 0.003
    log = attrs.evolve(quiet, dq=quiet.dq + 0.3 * rng.standard_normal(quiet.dq.shape))
    model = Model(Samples.of([log]), 0.0, np.ones((2, 2)), ONE, np.repeat([[0.008], [0.0]], 2, axis=1), ONE)
    both, own = np.ones(2, dtype=bool), np.arange(2)
    skew = AppliedEffect(TimestampSkewCandidate(TimestampSkew("dq")), both, np.full((1, 2), late), own)
    inertia = AppliedEffect(
        ArmatureCandidate(Armature(of="ddq_sharp")), both, np.full((1, 2), 0.5 * late), own
    )
    rows = model.samples.evaluated
    pair = model.with_effect(skew).with_effect(inertia)
    assert model.noise_averaged_by_effects(rows) == pytest.approx(0.0)
    removed = pair.noise_averaged_by_effects(rows)
    assert ((removed > 0.3 * (0.5 * 0.3) ** 2) & (removed < (0.5 * 0.3) ** 2)).all()


def test_other_splits_of_the_total_delay_are_tried():
    samples = Samples.of([_log(1.0)])
    wrong = Model(samples, 0.001, np.ones((2, 2)), ONE, np.repeat([[0.0035], [0.0045]], 2, axis=1), ONE)
    found = fit_delay_splits(wrong, samples.evaluated)
    assert found.delays[1] == pytest.approx(0.001, abs=5e-4)
    assert squared_error(found, samples.evaluated) < 0.99 * squared_error(wrong, samples.evaluated)


def test_parameters_that_one_frequency_does_not_separate_are_named():
    """A sine has dq, q and ddq in proportion, so that damping passes for an output delay."""
    rng, t = np.random.default_rng(5), np.arange(0.0, 4.0, 0.002)
    q = 0.3 * np.sin(2 * np.pi * 2.0 * t[:, None] + np.array([0.0, 1.0]))
    dq = 0.6 * 2 * np.pi * np.cos(2 * np.pi * 2.0 * t[:, None] + np.array([0.0, 1.0]))
    q_des = np.repeat(rng.uniform(-0.2, 0.2, (len(t) // 10, 2)), 10, axis=0)
    tau = 30.0 * (q_des - q) - 0.5 * dq + 0.05 * rng.standard_normal(q.shape)
    gains = {"kp": np.full(q.shape, 30.0), "kd": np.full(q.shape, 0.5)}
    log = Log("sine", JOINTS, t, q, dq, t, q_des, np.ones(q.shape, bool), tau=tau, **gains)
    samples = Samples.of([log])
    model = Model(samples, 0.0, np.ones((2, 2)), ONE, np.repeat([[0.001], [0.001]], 2, axis=1), ONE)
    starts = np.arange(0, len(t), 50)
    parts = DataSplit(samples.evaluated, samples.evaluated, samples.evaluated, starts)
    found = intervals(model, parts, np.full(2, 0.0025), np.zeros(2))
    assert ("delta_kd", "output_delay") in [one.names for one in found.inseparable]
    assert (found.total_delay < found.delays[1]).all()


def test_the_global_minimum_over_the_delays_is_found_with_step_commands():
    """With a step command every 5.25 ms, a fit from 2 ms away ends in a local minimum."""
    log = _driven(0.001, 0.00525, 2)
    samples = Samples.of([log])
    off = np.repeat([[0.0095], [0.0005]], 2, axis=1)
    stuck = fit(Model(samples, 0.0, np.ones((2, 2)), ONE, off, ONE), samples.evaluated)
    found = fit_delay_profile(stuck, samples.evaluated)
    assert squared_error(found, samples.evaluated) < 1.05 * 0.04 * samples.evaluated.sum()
    np.testing.assert_allclose(found.delays.sum(axis=0), 0.008, atol=5e-4)
