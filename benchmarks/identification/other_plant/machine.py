"""Joints under a sampled drive, integrated at 5 kHz by the velocity Verlet method.

Every joint is a pendulum: I q'' = tau - m sin(q) - d q'. The drive works on its own clock. Between its
ticks the torque is held, and it reaches the joint some ticks later.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TICK_S = 0.0002
"""Step of the integration, s."""
NEIGHBOUR_DRAG = "neighbour_drag"
PARAMETERS = (
    *("friction", "friction_width", "viscous", "quadratic", "offset", "spring", "cubic"),
    *("cog", "cog_waves", "limit", "lag", NEIGHBOUR_DRAG, "wave"),
)
"""Parameters of the drives' effects: N m, rad/s, N m s/rad, N m s^2/rad^2, N m, N m/rad, N m/rad^3, N m,
1/rad, N m, s, N m s/rad, N m.
"""
WAVE_RAD_S = 2.0 * np.pi * 7.3
"""Frequency of the torque `wave`, rad/s."""


@dataclass
class Machine:
    """Joints and their drives.

    Attributes:
        inertia: kg m^2, (J,).
        weight: N m, (J,), gravity torque of the horizontal link.
        damping: N m s/rad, (J,), outside of the drive.
        armature: kg m^2, (J,), between the drive's torque and the measured one.
        gains: kp (N m/rad) and kd (N m s/rad) that act.
        drive_ticks: Ticks between two computations of the drive.
        input_s: s, from a command to the drive.
        output_ticks: Ticks from the drive's torque to the joint.
        effects: Values (J,) by name of `PARAMETERS`; 0 for those that are missing.
    """

    inertia: Array
    weight: Array
    damping: Array
    armature: Array
    gains: tuple[float, float]
    drive_ticks: int
    input_s: float
    output_ticks: int
    effects: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Run:
    """Series of all ticks, (K, J): rad, rad/s, N m. `law` is the PD law alone, as the joint gets it."""

    q: Array
    dq: Array
    tau: Array
    law: Array


def run(machine: Machine, sent_s: Array, targets: Array, seconds: float) -> Run:
    """Simulate the machine.

    Args:
        machine: Joints and drives.
        sent_s: Times of the commands, (M,), s.
        targets: Commanded angles, (M, J), rad.
        seconds: Duration, s.

    Returns:
        Series of all ticks.
    """
    ticks = round(seconds / TICK_S)
    newest = np.searchsorted(sent_s + machine.input_s, np.arange(ticks) * TICK_S + 1e-9, side="right") - 1
    arrived = targets[np.maximum(newest, 0)]
    values = np.zeros((len(PARAMETERS), targets.shape[1]))
    for name, value in machine.effects.items():
        values[PARAMETERS.index(name)] = value
    out = np.zeros((4, ticks, targets.shape[1]))
    _compiled()(
        arrived,
        np.stack([machine.inertia, machine.weight, machine.damping, machine.armature]),
        np.array(machine.gains),
        np.array([machine.drive_ticks, machine.output_ticks]),
        values,
        out,
    )
    return Run(*out)


@cache
def _compiled() -> Callable[..., None]:
    """The compiled loop over the ticks."""
    import numba

    def loop(target: Any, body: Any, gains: Any, clock: Any, values: Any, out: Any) -> None:
        ticks, joints = target.shape
        q, dq, force = target[0].copy(), np.zeros(joints), np.zeros(joints)
        lagged, held, pure = np.zeros(joints), np.zeros(joints), np.zeros(joints)
        queue, laws = np.zeros((clock[1] + 1, joints)), np.zeros((clock[1] + 1, joints))
        for k in range(ticks):
            slot = k % (clock[1] + 1)
            for j in range(joints):
                if k % clock[0] == 0:
                    friction, width, viscous, quadratic, offset, spring, cubic = values[:7, j]
                    cog, waves, limit, lag, drag, wave = values[7:, j]
                    law = gains[0] * (target[k, j] - q[j]) - gains[1] * dq[j]
                    torque = law
                    if limit > 0.0:
                        torque = min(max(torque, -limit), limit)
                    if lag > 0.0:
                        share = 1.0 - np.exp(-clock[0] * TICK_S / lag)
                        lagged[j] += share * (torque - lagged[j])
                        torque = lagged[j]
                    if friction > 0.0:
                        torque -= friction * min(max(dq[j] / width, -1.0), 1.0)
                    torque -= viscous * dq[j] + quadratic * dq[j] * abs(dq[j])
                    torque += offset - spring * q[j] - cubic * q[j] ** 3
                    torque += cog * np.sin(waves * q[j]) + wave * np.sin(WAVE_RAD_S * k * TICK_S)
                    torque -= drag * dq[(j + 1) % joints]
                    held[j], pure[j] = torque, law
                queue[slot, j], laws[slot, j] = held[j], pure[j]
            last = (k + 1) % (clock[1] + 1) if k >= clock[1] else 0
            for j in range(joints):
                tau = queue[last, j]
                # Velocity Verlet, with the armature as part of the inertia.
                inertia = body[0, j] + body[3, j]
                new_q = q[j] + dq[j] * TICK_S + 0.5 * force[j] * TICK_S**2
                half = dq[j] + 0.5 * force[j] * TICK_S
                new_force = (tau - body[1, j] * np.sin(new_q) - body[2, j] * half) / inertia
                out[0, k, j], out[1, k, j] = q[j], dq[j]
                out[2, k, j] = tau - body[3, j] * new_force
                out[3, k, j] = laws[last, j]
                q[j], dq[j], force[j] = new_q, half + 0.5 * new_force * TICK_S, new_force

    return numba.njit(loop, cache=True)
