"""A joint whose torque never changes sign, because of an offset, has an offset: no spring, no learned curve."""

import attrs
import numpy as np
import pytest

from quadvel_sysid.data.plain_model import fit_eam
from quadvel_sysid.data.signals import Samples
from quadvel_sysid.identify import identify
from quadvel_sysid.logs.log import Log

DT, STEPS = 0.004, 4  # s, a row; steps of the simulation in it
FRICTION_WIDTH = 0.05  # rad/s
INERTIA, DAMPING = np.array([0.08, 0.05]), 0.2  # kg m^2, N m s/rad


def one_sided(
    sign: float, kp: float, kd: float, coulomb: tuple[float, float], seed: int, late: int = 1
) -> Log:
    """Two joints under PD control, commands some rows late; an offset lifts the second one's torque past zero.

    Args:
        sign: Sign of the second joint's torque.
        kp: N m/rad.
        kd: N m s/rad.
        coulomb: N m, friction of each drive, that the torque sensor sees.
        seed: Seed of the noise.
        late: Rows by which commands are late.

    Returns:
        A log of 16 s without gains.
    """
    random, t = np.random.default_rng(seed), DT * np.arange(4000)
    one = 0.4 * np.sin(2 * np.pi * 0.5 * t) + 0.2 * np.sin(2 * np.pi * 1.3 * t)
    q_des = np.stack([one, 0.5 * np.sin(2 * np.pi * 0.8 * t)], axis=1)
    q, dq, rows = q_des[0].copy(), np.zeros(2), []
    for i in range(len(t)):
        drive = kp * (q_des[max(i - late, 0)] - q) - kd * dq
        tau = drive - np.array(coulomb) * np.tanh(dq / FRICTION_WIDTH)
        rows.append([tau + 0.01 * random.standard_normal(2), q, dq])
        for _ in range(STEPS):
            friction = np.array(coulomb) * np.tanh(dq / FRICTION_WIDTH)
            dq = dq + (drive - friction - DAMPING * dq) / INERTIA * DT / STEPS
            q = q + dq * DT / STEPS
    tau, q_rows, dq_rows = np.array(rows).swapaxes(0, 1)
    tau[:, 1] += sign * (0.006 - (sign * tau[:, 1]).min())
    states = {"q": q_rows.round(5), "dq": dq_rows.round(4), "tau": tau.round(3)}
    names = ("shoulder_joint", "wrist_joint")
    every = np.ones(q_des.shape, bool)
    return Log(name="one_sided", joints=names, t=t, t_cmd=t, q_des=q_des.round(5), valid=every, **states)


@pytest.mark.parametrize(
    ("sign", "kp", "kd", "coulomb"),
    [(1.0, 60.0, 1.5, (0.4, 0.1)), pytest.param(-1.0, 45.0, 1.1, (0.25, 0.15), marks=pytest.mark.long)],
)
def test_an_offset_that_keeps_a_torque_from_changing_sign_is_named(sign, kp, kd, coulomb):
    report = identify([one_sided(sign, kp, kd, coulomb, seed=11)]).report
    found = {effect["name"]: effect["joints"] for effect in report["effects"]}
    assert found == {
        "torque_offset": ["wrist_joint"],
        "coulomb_friction": ["shoulder_joint", "wrist_joint"],
    }


@pytest.mark.parametrize(
    ("sign", "kp", "kd", "late"), [(-1.0, 60.0, 1.5, 1), (1.0, 55.0, 1.3, 2), (-1.0, 25.0, 0.8, 4)]
)
def test_an_offset_does_not_choose_the_delays_of_the_plain_model(sign, kp, kd, late):
    log = one_sided(sign, kp, kd, (0.25, 0.15), seed=11, late=late)
    without = attrs.evolve(log, tau=log.tau - [0.0, log.tau[:, 1].mean()])
    found = []
    for one in (log, without):
        samples = Samples.of([one])
        eam = fit_eam(samples, samples.evaluated)
        found.append([eam.input_delay, eam.output_delay])
    np.testing.assert_allclose(*found, atol=0.25 * DT)
