"""What happens between the rows of a log, and channels that are stamped off, each against a computation of its own."""

import attrs
import numpy as np
import pytest
from simulated_joints import NAMES, parameters, record
from test_screening import about

from quadvel_actuator.effects import registry
from quadvel_actuator.identify.candidates import propose, started
from quadvel_actuator.identify.delays import latest
from quadvel_actuator.identify.eam import fit_eam
from quadvel_actuator.identify.log import Log
from quadvel_actuator.identify.model import Applied, Model
from quadvel_actuator.identify.signals import Samples


def test_a_slew_limit_is_followed_between_the_rows():
    """Of a drive that computes every 50 us, on rows of 2 ms with one or two commands between them."""
    dt, rate, rng = 5e-5, 60.0, np.random.default_rng(4)
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
    law = registry()["slew_limit"]()
    one = np.zeros(1, dtype=np.intp)
    gains = np.array([[30.0], [0.0]])
    limit = Applied(law, np.ones(1, dtype=bool), np.array([[rate]]), one)
    model = Model(Samples([log]), 0.0, gains, np.array([one, one]), np.zeros(1), np.zeros(1), one, (limit,))
    limited = np.abs(asked - tau)[step] > 0.05
    assert limited.mean() > 0.2
    assert np.sqrt(np.mean((model.predict()[:, 0] - tau[step])[10:] ** 2)) < 0.008


@pytest.mark.parametrize(("channel", "late"), [("q", -0.009), ("q", 0.009), ("dq", -0.006), ("dq", 0.01)])
def test_a_channel_stamped_early_or_late_on_one_joint_is_found(channel, late):
    """Beside the others: what all are off by is next to a delay. Damping may say as much of a position, but not more."""
    truth = attrs.evolve(parameters(input_delay=0.009, output_delay=0.003), joints=NAMES[:3])
    log = record(truth, 3, 3.0, 500, "mixed", 2)
    values = getattr(log, channel).copy()
    values[:, 0] = np.interp(log.t + late, log.t, values[:, 0])
    looked = about(attrs.evolve(log, **{channel: values}), 0.009, 0.003)
    found = {}
    for name in ("timestamp_skew", "viscous_friction"):
        forms = [started(looked, form) for form in registry()[name].variants(looked)]
        tried = [propose(looked, one) for one in forms if one is not None]
        found[name] = max((one for one in tried if one is not None), key=lambda one: one.gain, default=None)
    best, other = found["timestamp_skew"], found["viscous_friction"]
    assert other is None or best.gain > 0.99 * other.gain
    assert best.law.channel == channel
    moved = np.where(best.joints, best.model.applied[-1].values[0], 0.0)
    np.testing.assert_allclose(moved - np.median(moved), [late, 0.0, 0.0], atol=0.0006)


def test_of_delays_that_a_grid_of_stamps_cannot_tell_the_whole_step_is_taken():
    t, rng = np.arange(3000) * 0.001, np.random.default_rng(1)
    q = 0.3 * np.sin(2 * np.pi * 3.0 * t[:, None] + np.array([0.0, 1.0]))
    dq = np.gradient(q, 0.001, axis=0)
    q_des = q + 0.2 * np.sin(2 * np.pi * 5.0 * t[:, None])
    tau = np.zeros_like(q)
    tau[8:] = 29.0 * (q_des[:-8] - q[7:-1]) - 0.48 * dq[7:-1]
    tau += 0.2 * rng.standard_normal(q.shape)
    gains = {"kp": np.full(q.shape, 30.0), "kd": np.full(q.shape, 0.5)}
    log = Log("grid", NAMES[:2], t, q, dq, t, q_des, np.ones(q.shape, bool), tau=tau, **gains)
    samples = Samples([log])
    eam = fit_eam(samples, samples.judged)
    one = np.zeros(2, dtype=np.intp)
    model = Model(
        samples, eam.window, eam.gains, np.array([one, one]), eam.input_delay, eam.output_delay, one
    )
    assert eam.output_delay[0] == pytest.approx(0.001, abs=2e-4)
    assert latest(model, samples.judged)[0] == pytest.approx(0.007, abs=2e-4)
