"""Logs without measured torque: what commands and encoders alone show (friction, armature, damping, encoder bias).

A joint that turns freely says what torque it got: inertia times acceleration, and a load that depends on its place.
Inertia and load are fitted together with the PD law; the torque that they imply then stands for a measured one, and
the same diagnosis runs on it. What is gained is told in rad and rad/s, by replaying the commands through the model
over short stretches. Contacts with the ground are not in it: the robot hangs in the air.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from ..model import ActuatorModel
from ..parameters import ActuatorParameters
from .eam import LONGEST_INPUT
from .log import Log, LogError
from .signals import Array, Bools, Samples

STRETCH = 0.05
"""s that are replayed from a measured state before the next one is taken"""

_DELAY_STEP = 0.0005  # s


@attrs.frozen(eq=False)
class Rigid:
    """What a joint carries, each (J,): inertia (kg m^2), and the load stiffness q + constant, N m."""

    inertia: Array
    stiffness: Array
    constant: Array

    def load(self, q: Array) -> Array:
        """Torque that holds the joint at `q`, N m."""
        torque: Array = self.stiffness * q + self.constant
        return torque


def implied(log: Log, kp: Array | None, kd: Array | None) -> tuple[Log, Rigid]:
    """The log with the torque that its motion implies, and what the joints carry.

    Raises LogError where the gains are not known: without torque the scale of everything hangs on them.
    """
    if (log.kp is None and kp is None) or (log.kd is None and kd is None):
        raise LogError(
            f"{log.name}: tau, kp: both are missing, expected the torque or the gains (--gains KP KD)"
        )
    samples = Samples([log], kp, kd)
    found = min(
        (_regressed(samples, delay) for delay in np.arange(0.0, LONGEST_INPUT, _DELAY_STEP)),
        key=lambda one: one[0],
    )
    rigid = found[1]
    for joint, inertia in zip(log.joints, rigid.inertia, strict=True):
        if inertia <= 0.0:
            raise LogError(
                f"{log.name}: q/{joint}: the motion implies an inertia of {inertia:.3g} kg m^2; expected a joint "
                "that turns freely (the robot hung in the air), or a measured tau"
            )
    s = samples.at(0.0, 0.0, 0.0)
    gains: dict[str, Any] = {name: np.array(samples.logs[0].gains[name]) for name in ("kp", "kd")}
    return attrs.evolve(log, tau=rigid.inertia * s.ddq + rigid.load(s.q), **gains), rigid


def _regressed(samples: Samples, delay: float) -> tuple[float, Rigid]:
    """Share of the acceleration that a delay leaves unexplained, and what the joints carry then."""
    s = samples.at(delay, 0.0, 0.0)
    torque = s.kp * (s.q_des - s.q) + s.kd * (s.dq_des - s.dq) + s.tau_ff
    share, rows = 0.0, []
    for j in range(s.q.shape[1]):
        keep = samples.judged[:, j]
        x = np.column_stack(
            [torque[keep, j], s.q[keep, j], s.dq[keep, j], np.tanh(s.dq[keep, j] / 0.05), np.ones(keep.sum())]
        )
        y = s.ddq[keep, j]
        solution = np.linalg.lstsq(x, y, rcond=None)[0]
        share += float(np.mean((y - x @ solution) ** 2) / (np.var(y) + 1e-12))
        inertia = 1.0 / solution[0] if solution[0] > 0.0 else -1.0
        rows.append((inertia, -solution[1] * inertia, -solution[4] * inertia))
    return share, Rigid(*np.array(rows).T)


def replayed(
    logs: Sequence[Log], parameters: ActuatorParameters, rigid: Rigid, rows: Bools
) -> dict[str, float]:
    """Root mean square errors of q (rad) and dq (rad/s) over `rows` (N, J) of all logs, replaying STRETCH at a time."""
    errors = np.concatenate([_replay(log, parameters, rigid) for log in logs], axis=1)
    count = max(int(rows.sum()), 1)
    sizes = np.sqrt(np.sum(np.where(rows, errors, 0.0) ** 2, axis=(1, 2)) / count)
    return {"q_rms_rad": float(sizes[0]), "dq_rms_rad_s": float(sizes[1])}


def _replay(log: Log, parameters: ActuatorParameters, rigid: Rigid) -> Array:
    """Errors (2, N, J) of q and dq."""
    dt = log.period
    model = ActuatorModel(attrs.evolve(parameters, torque_noise=0.0), (len(log.joints),), dt)
    packet = log.command_rows(log.t)
    kp, kd = np.asarray(log.kp)[packet], np.asarray(log.kd)[packet]
    q, dq = np.asarray(log.q, dtype=float), np.asarray(log.dq, dtype=float)
    errors = np.zeros((2, *log.q.shape))
    every = max(2, round(STRETCH / dt))
    place, speed = q[0], dq[0]
    for n in range(len(log.t)):
        if n % every == 0:
            place, speed = q[n], dq[n]
        errors[:, n] = place - q[n], speed - dq[n]
        torque = model.step(place, speed, log.q_des[packet[n]], kp[n], kd[n])
        speed = speed + dt * (torque - rigid.load(place)) / rigid.inertia
        place = place + dt * speed
    return errors
