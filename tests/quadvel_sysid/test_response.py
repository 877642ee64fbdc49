"""The torque answers the position error on joints whose commands do not show the lag of the drive."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_sysid.logs.check_log import check_log
from quadvel_sysid.logs.log import Log

PERIOD, STEPS = 0.005, 10  # s, a row; steps of the simulation in it


def log_of(q: np.ndarray, dq: np.ndarray, q_des: np.ndarray, tau: np.ndarray, **more: np.ndarray) -> Log:
    """A log without gains of joints `a`, `b` and so on, `PERIOD` apart."""
    t = PERIOD * np.arange(len(q))
    names = tuple(f"{letter}_joint" for letter in "abcdefgh"[: q.shape[1]])
    return Log("a.npz", names, t, q, dq, t, q_des, np.ones(q.shape, bool), tau, **more)


def one_frequency(hertz: float, sign: float) -> Log:
    """A joint that follows a sine 20 ms late with 0.9 of the amplitude, torque times `sign`."""
    t = PERIOD * np.arange(800)[:, None]
    angle, amplitude = 2.0 * np.pi * hertz, 0.3
    q_des, q = amplitude * np.sin(angle * t), 0.9 * amplitude * np.sin(angle * (t - 0.02))
    dq = np.gradient(q, PERIOD, axis=0)
    noise = np.random.default_rng(0).normal(0.0, 0.01, q.shape)
    return log_of(q, dq, q_des, sign * (20.0 * (q_des - q) - 0.5 * dq + noise))


def stiff_arm(seed: int) -> Log:
    """Seven joints of kp 900 N m/rad whose drives feed the commanded speed forward, one row late."""
    random, count, joints = np.random.default_rng(seed), 3200, 7
    inertia, gravity = np.linspace(0.9, 0.1, joints), np.linspace(25.0, 2.0, joints)
    coulomb = np.linspace(2.0, 0.3, joints)
    start = round(3.0 / PERIOD)  # rows before the log begins
    t = PERIOD * np.arange(-start, count)[:, None]
    (slow, fast), phases = random.uniform(0.2, 0.7, (2, joints)), random.uniform(0.0, 6.0, (2, joints))
    q_des = 0.6 * np.sin(2.0 * np.pi * slow * t + phases[0])
    q_des = q_des + 0.3 * np.sin(2.0 * np.pi * 1.7 * fast * t + phases[1])
    dq_des = np.gradient(q_des, PERIOD, axis=0)
    q, dq, rows = q_des[0].copy(), dq_des[0].copy(), []
    for i in range(len(t)):
        late = max(i - 1, 0)
        drive = 900.0 * (q_des[late] - q) + 30.0 * (dq_des[late] - dq)
        rows.append((q, dq, drive + 0.05 * random.standard_normal(joints)))
        for _ in range(STEPS):
            load = gravity * np.sin(q) + coulomb * np.tanh(dq / 0.05) + dq
            dq = dq + (drive - load) / inertia * PERIOD / STEPS
            q = q + dq * PERIOD / STEPS
    states, speeds, torques = np.array(rows)[start:].swapaxes(0, 1)
    return log_of(states, speeds, q_des[start:], torques, dq_des=dq_des[start:])


def about_the_answer(log: Log) -> list[str]:
    """Kinds of the findings that the torque does not answer the position error."""
    return [one.kind for one in check_log(log).findings if "answer the position error" in one.text]


@pytest.mark.parametrize("hertz", [0.5, 0.7, 0.9, 1.1, 1.6])
def test_torque_answers_a_command_of_one_frequency(hertz: float) -> None:
    assert about_the_answer(one_frequency(hertz, 1.0)) == []


@pytest.mark.parametrize("hertz", [0.5, 0.7, 0.9, 1.1, 1.6])
def test_torque_of_the_wrong_sign_does_not_answer_a_command_of_one_frequency(hertz: float) -> None:
    assert about_the_answer(one_frequency(hertz, -1.0)) == ["refusal"]


@pytest.mark.parametrize("seed", [501, 503, 504])
def test_torque_of_a_stiff_joint_answers_although_the_commanded_speed_leads(seed: int) -> None:
    log = stiff_arm(seed)
    assert about_the_answer(log) == []
    assert about_the_answer(log.select_joints(("e", "g"))) == []
