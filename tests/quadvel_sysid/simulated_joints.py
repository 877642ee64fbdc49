"""Simulated joints under the actuator model, as logs with known parameters."""

import attrs
import numpy as np

from quadvel_actuator import ActuatorModel, ActuatorParameters, DelayPair
from quadvel_sysid.logs.log import Log
from tests.helpers.robots import ALIENGO

NAMES = tuple(f"{leg}_{part}_joint" for leg in ("FR", "FL", "RR", "RL") for part in ("hip", "thigh", "calf"))
TABLE_4 = {
    "delta_kp": -0.706,
    "delta_kd": -0.021,
    "input_delay": 0.007,
    "output_delay": 0.001,
    "noise": 0.066,
}


def parameters(effects=(), joints=12, **values):
    """Actuator parameters with Table 4 of the paper, changed by `values`, and some effects."""
    given = TABLE_4 | values
    pair = DelayPair(given["input_delay"], given["output_delay"], given["noise"])
    return attrs.evolve(
        ActuatorParameters.of(ALIENGO),
        delta_kp=given["delta_kp"],
        delta_kd=given["delta_kd"],
        pairs=(pair,),
        torque_noise=given["noise"],
        torque_limit=200.0,
        effects=effects,
    )


def targets(t, joints, rng, motion="lift"):
    """Joint targets (N, J), rad, updated at 200 Hz: trotting steps, or chirps with random offsets."""
    held = np.floor(t * 200 + 1e-6) / 200
    phase = rng.uniform(0, 2 * np.pi, joints)
    amplitude = rng.uniform(0.12, 0.3, joints)
    if motion == "lift":
        k = np.maximum(np.sin(2 * np.pi * 2.0 * held[:, None] + phase), -0.15)
        return amplitude * k + 0.1 * np.sin(2 * np.pi * 0.7 * held[:, None] + 2 * phase)
    sweep = 2 * np.pi * (0.5 * held + 0.5 * 1.1 * held**2)
    steps = rng.uniform(-0.15, 0.15, (int(t[-1] * 2) + 2, joints))[(held * 2).astype(int)]
    return amplitude * np.sin(sweep[:, None] + phase) + steps


def record(
    truth,
    joints=12,
    seconds=5.0,
    rate=1000,
    motion="lift",
    seed=0,
    inertia=0.06,
    distort=None,
    extra=None,
    load=4.0,
):
    """Simulate joints with inertia and a ground load, and log them.

    Args:
        truth: Parameters of the actuators, which run at 1 kHz.
        joints: Number of joints J.
        seconds: Duration of the log, s.
        rate: Rate of the rows, Hz.
        motion: `lift` for trotting steps, anything else for chirps with random offsets.
        seed: Seed of motion, load and noise.
        inertia: Inertia of each joint, kg m^2.
        distort: Changes the torque by an effect outside the model: (k, q, dq, tau) -> tau.
        extra: Further fields of the log.
        load: Peak torque of the ground, N m.

    Returns:
        A log of N rows and J joints.
    """
    dt, rng = 0.001, np.random.default_rng(seed)
    noise = np.sqrt(truth.torque_noise)
    model = ActuatorModel(attrs.evolve(truth, torque_noise=0.0), (joints,), dt, seed)
    n = int(seconds / dt)
    t = np.arange(n) * dt
    q_des = targets(t, joints, rng, motion)
    load_phase = rng.uniform(0, 2 * np.pi, joints)
    q, dq = q_des[0].copy(), np.zeros(joints)
    rows = np.empty((3, n, joints))
    for k in range(n):
        tau = model.step(q, dq, q_des[k], 30.0, 0.5)
        if distort is not None:
            tau = distort(k, q, dq, tau)
        rows[:, k] = q, dq, tau
        ground = load * np.maximum(np.sin(2 * np.pi * 2.0 * t[k] + load_phase), 0.0) ** 2
        dq = dq + dt * (tau - ground - 0.3 * dq) / inertia
        q = q + dt * dq
    q, dq, tau = rows
    tau = tau + noise * rng.normal(size=tau.shape)
    step = round(1000 / rate)
    return Log(
        name=f"simulated-{seed}",
        joints=NAMES[:joints],
        t=t[::step],
        q=q[::step],
        dq=dq[::step],
        tau=tau[::step],
        t_cmd=t,
        q_des=q_des,
        valid=np.ones((len(t[::step]), joints), dtype=bool),
        kp=np.full((n, joints), 30.0),
        kd=np.full((n, joints), 0.5),
        **(extra or {}),
    )
