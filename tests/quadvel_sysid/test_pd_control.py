"""Stretches out of PD control are found, and a drive that starts under a load or an offset is not one."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

from quadvel_sysid.logs.check_log import check_log
from quadvel_sysid.logs.log import Log

STEPS = 4  # steps of the simulation in a row of the log


def axis(period: float, kp: float, kd: float, late: int, lead: float, seed: int) -> Log:
    """An axis with friction and gravity that starts from rest at its first command, 10 s without gains.

    Args:
        period: s, from row to row.
        kp: N m/rad.
        kd: N m s/rad.
        late: Delay of the commands, rows.
        lead: Share of kd times the commanded speed that the drive feeds forward, which is not logged.
        seed: Seed of the phases and the noise.
    """
    random, t = np.random.default_rng(seed), period * np.arange(round(10.0 / period))
    phase = random.uniform(0.0, 6.0)
    q_des = 0.4 * np.sin(np.pi * t) + 0.2 * np.sin(2.6 * np.pi * t + phase)
    dq_des, inertia = np.gradient(q_des, period), kp / 750.0
    q, dq, rows = q_des[0], 0.0, []
    for i in range(len(t)):
        k = max(i - late, 0)
        drive = kp * (q_des[k] - q) + kd * (lead * dq_des[k] - dq)
        friction = 0.005 * kp * np.tanh(dq / 0.05)
        rows.append((q, dq, drive - friction + 2e-4 * kp * random.standard_normal()))
        for _ in range(STEPS):
            load = 0.005 * kp * np.tanh(dq / 0.05) + 0.01 * kp * np.sin(q) + 0.003 * kp * dq
            dq += (drive - load) / inertia * period / STEPS
            q += dq * period / STEPS
    states = np.array(rows).T[:, :, None]
    every = np.ones((len(t), 1), bool)
    return Log("a.npz", ("a_joint",), t, *states[:2], t, q_des[:, None], every, states[2])


def left_out(log: Log) -> list[float]:
    """Seconds of each finding that the torque no longer answers the position error."""
    checked = check_log(log)
    lost = ~checked.log.valid.any(axis=1)
    hit = [one for one in checked.findings if one.text.startswith("tau: the torque no longer answers")]
    return [float(lost.sum() * log.period)] * len(hit)


def raised(log: Log, offset: float) -> Log:
    """The log with a constant offset (N m) of its torque."""
    assert log.tau is not None
    return attrs.evolve(log, tau=log.tau + offset)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("offset", [0.0, 3.0, 8.0, -8.0])
def test_start_from_rest_under_an_offset_is_pd_control(offset: float, seed: int) -> None:
    assert left_out(raised(axis(0.004, 60.0, 1.5, 1, 0.0, seed), offset)) == []


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("offset", [0.0, 800.0])
def test_start_from_rest_with_the_commanded_speed_not_logged_is_pd_control(offset: float, seed: int) -> None:
    assert left_out(raised(axis(0.002, 8000.0, 80.0, 2, 1.0, seed), offset)) == []


@pytest.mark.parametrize("offset", [0.0, 3.0, 8.0, -8.0])
def test_damping_under_an_offset_is_not_pd_control(offset: float) -> None:
    log = axis(0.004, 60.0, 1.5, 1, 0.0, seed=0)
    assert log.tau is not None
    damped = (log.t > 4.0) & (log.t < 6.0)
    log = attrs.evolve(log, tau=np.where(damped[:, None], -0.4 * log.dq, log.tau))
    (seconds,) = left_out(raised(log, offset))
    assert 1.8 < seconds < 2.4
