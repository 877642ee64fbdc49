"""Logs of three simulated servos with one defect each, computed without the model."""

from __future__ import annotations

from typing import Any

import numpy as np

JOINTS = ("hip", "thigh", "calf")
KP, KD, DELAY, FRICTION = 30.0, 0.8, 5, 0.6  # N m/rad, N m s/rad, ms, N m


def recorded(
    seed: int = 0, seconds: float = 6.0, every: int = 4, middle: float = 0.1, ticks: float = 0.0
) -> dict[str, Any]:
    """Joints with inertia, gravity and friction in the drive, commanded at 50 Hz; a row every `every` ms.

    With `ticks` (rad) the drive acts on what its encoder counts and on the difference of that.
    """
    random, n = np.random.default_rng(seed), round(seconds * 1000)
    t = 0.001 * np.arange(n)
    pulse, phase = 2.0 * np.pi * random.uniform(0.3, 2.5, (5, 3)), random.uniform(0.0, 6.0, (5, 3))
    sent = middle + (random.uniform(0.05, 0.2, (5, 3)) * np.sin(t[:, None, None] * pulse + phase)).sum(axis=1)
    sent = sent[np.arange(n) // 20 * 20]
    inertia, weight = np.array([0.06, 0.08, 0.04]), np.array([0.0, 1.2, 0.7])
    q, dq, rows = sent[0].copy(), np.zeros(3), np.empty((3, n, 3))
    counted, before = q, q
    for k in range(n):
        if ticks and k % every == 0:
            before, counted = counted, np.round(q / ticks) * ticks
        seen = (counted, (counted - before) / (0.001 * every)) if ticks else (q, dq)
        tau = KP * (sent[max(k - DELAY, 0)] - seen[0]) - KD * seen[1] - FRICTION * np.tanh(dq / 0.05)
        rows[:, k] = (*seen, tau) if ticks else (q, dq, tau)
        dq = dq + 0.001 * (tau - weight * np.sin(q) - 0.05 * dq) / inertia
        q = q + 0.001 * dq
    angle, speed, torque = rows[:, ::every]
    noise = random.normal(size=(3, *angle.shape))
    return {
        "t": t[::every],
        "q": angle if ticks else angle + 1e-4 * noise[0],
        "dq": speed if ticks else speed + 0.02 * noise[1],
        "tau": torque + 0.05 * noise[2],
        "q_des": sent[::every].copy(),
        "kp": KP,
        "kd": KD,
        "joint_names": JOINTS,
    }
