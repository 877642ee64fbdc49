"""Effects between the rows of a log, and skewed channels, compared with independent computations."""

import attrs
import numpy as np
import pytest

from quadvel_actuator.effects.dynamics import FirstOrderLag, VelocityFilter
from quadvel_actuator.effects.limits import SlewLimit
from quadvel_sysid.data.signals import Samples
from quadvel_sysid.identify import identify
from quadvel_sysid.logs.excerpts import has_jitter, restore_even_clock
from quadvel_sysid.logs.log import Log
from quadvel_sysid.logs.read_log import read_log
from quadvel_sysid.model.applied_effect import AppliedEffect
from quadvel_sysid.model.torque_model import Model
from quadvel_sysid.search.effect_candidates.dynamics import LagCandidate, VelocityFilterCandidate
from quadvel_sysid.search.effect_candidates.limits import SlewLimitCandidate
from tests.quadvel_sysid.joint_logs import fields, npz
from tests.quadvel_sysid.simulated_joints import NAMES, parameters, record


def _slewing(rate):
    """Log of a drive with a step of 50 us, with a row every 2 ms, and its requested torque."""
    dt, rng = 5e-5, np.random.default_rng(4)
    t = np.arange(20000) * dt
    q = 0.3 * np.sin(2 * np.pi * 3.0 * t)
    sent = np.unique(np.round(np.cumsum(rng.uniform(0.0009, 0.004, 600)) / dt).astype(int))
    sent = np.concatenate([[0], sent[sent < len(t)]])
    targets = 0.3 * np.sin(2 * np.pi * 3.0 * t[sent] + 0.4)
    asked = 30.0 * (targets[np.searchsorted(sent, np.arange(len(t)), side="right") - 1] - q)
    held, tau = asked[0], np.empty(len(t))
    for k, u in enumerate(asked):
        held = tau[k] = min(max(u, held - rate * dt), held + rate * dt)
    step = slice(None, None, 40)
    log = Log("slow", NAMES[:1], t[step], q[step, None], np.gradient(q, dt)[step, None], t[sent], targets[:, None],
              np.ones((500, 1), bool), tau=tau[step, None])  # fmt: skip
    return log, asked[step]


def test_a_slew_limit_is_simulated_between_rows():
    rate = 60.0
    log, asked = _slewing(rate)
    tau = log.tau[:, 0]
    candidate = SlewLimitCandidate(SlewLimit())
    one = np.zeros(1, dtype=np.intp)
    gains = np.array([[30.0], [0.0]])
    limit = AppliedEffect(candidate, np.ones(1, dtype=bool), np.array([[rate]]), one)
    model = Model(Samples.of([log]), 0.0, gains, one, np.zeros((2, 1)), one, (limit,))
    limited = np.abs(asked - tau) > 0.05
    assert limited.mean() > 0.2
    assert np.sqrt(np.mean((model.predict()[:, 0] - tau)[10:] ** 2)) < 0.008


def _of_one_joint(log, candidate, value, input_delay=0.0):
    one = np.zeros(1, dtype=np.intp)
    applied = AppliedEffect(candidate, np.ones(1, dtype=bool), np.array([[value]]), one)
    gains = np.array([[30.0], [1.0]])
    delays = np.array([[input_delay], [0.0]])
    return Model(Samples.of([log]), 0.0, gains, one, delays, one, (applied,))


def test_a_lag_is_recomputed_at_other_delays_with_the_same_commands():
    """On a grid of 2 ms, delays of 0.5 and 1.5 ms see the same commands with another age."""
    candidate = LagCandidate(FirstOrderLag())
    model = _of_one_joint(_driven(0.002, 0.002, 3), candidate, 0.004, 0.0005)
    model.predict()
    later = model.with_delays(np.array([[0.0015], [0.0]]))
    fresh = _of_one_joint(_driven(0.002, 0.002, 3), candidate, 0.004, 0.0015)
    assert np.array_equal(later.predict(), fresh.predict())
    assert np.abs(later.predict() - model.predict()).max() > 0.01


def test_a_filtered_velocity_is_simulated_between_rows():
    """Amplitude and phase of a sine of 8 Hz after a lag of 6 ms, in closed form, from rows of 2 ms."""
    w, lag = 2 * np.pi * 8.0, 0.006
    t = np.arange(0.0, 2.0, 0.002)
    dq = np.sin(w * t)
    log = Log("sine", NAMES[:1], t, 0.0 * t[:, None], dq[:, None], t, 0.0 * t[:, None], np.ones((len(t), 1), bool),
              tau=0.0 * t[:, None])  # fmt: skip
    predicted = _of_one_joint(log, VelocityFilterCandidate(VelocityFilter()), lag).predict()[:, 0]
    filtered = np.sin(w * t - np.arctan(w * lag)) / np.hypot(1.0, w * lag)
    settled = t > 0.1
    assert np.abs(predicted + filtered)[settled].max() < 0.01


@pytest.mark.parametrize(
    ("channel", "late"), [pytest.param("q", -0.009, marks=pytest.mark.long), ("dq", 0.01)]
)
def test_a_channel_stamped_early_or_late_on_one_joint_is_found(channel, late):
    truth = attrs.evolve(parameters(input_delay=0.009, output_delay=0.003), joints=NAMES[:3])
    log = record(truth, 3, 4.0, 500, "mixed", 2)
    values = getattr(log, channel).copy()
    values[:, 0] = np.interp(log.t + late, log.t, values[:, 0])
    report = identify([attrs.evolve(log, **{channel: values})]).report
    named = {name for one in report["effects"] for name in (one["name"], *one["indistinguishable"])}
    assert "timestamp_skew" in named
    assert report["after"]["heldout_mse"] < 1.15 * 0.066


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


def test_the_stamps_of_a_regular_sender_are_restored_from_rows_with_commands(tmp_path):
    """At 97 Hz in rows of 500 Hz a command appears up to 2 ms late, as after a lost command."""
    rows = fields()
    sending = np.floor(rows["t"] * 97.0 + 1e-9)
    rows["q_des"] = rows["q_des"][np.searchsorted(sending, sending)]
    log = read_log(npz(tmp_path / "log.npz", q_des=rows["q_des"]))
    assert has_jitter(log)
    even = restore_even_clock(log).t_cmd
    assert len(even) == len(np.unique(sending))
    assert np.abs(np.diff(even)[2:-2] - 1.0 / 97.0).max() < 5e-4
    assert 0.0 < (even - np.unique(sending) / 97.0)[2:-2].mean() < 0.002
