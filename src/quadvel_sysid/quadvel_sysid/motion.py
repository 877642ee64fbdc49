"""Logs without measured torque: what commands and encoders alone show (friction, damping, encoder bias).

Limbs that swing freely say what torque their joints got: accelerations go with torques, and with a load that depends on
place and speed. Both are fitted together with the PD law and a friction that stays out of them; the torque that the
motion then implies stands for a measured one, and the same diagnosis runs on it. Torque is known to a scale only, that of
the commanded gains. What is gained is told in rad and rad/s, by replaying the commands over short stretches. Contacts with
the ground are not in it: the robot hangs in the air.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.model import ActuatorModel
from quadvel_actuator.parameters import ActuatorParameters

from .eam import MAX_INPUT_DELAY_S
from .logs.log import Log, LogError
from .signals import Array, Bools, Samples

STRETCH = 0.05
"""s that are replayed from a measured state before the next one is taken"""

_SPAN = 0.008  # s over which an acceleration is taken: encoders are too coarse for less
_DELAY_STEP = 0.0005  # s
_STEP = 0.001  # s of the replay, at most
_LARGEST = 4  # joints that may carry each other
_RIDGE = 1e-5


Replay = dict[str, float]


@attrs.frozen(eq=False)
class Limb:
    """Joints that carry each other: how they accelerate, linear about the middle of the motion."""

    joints: NDArray[np.intp]  # (K,)
    middle: Array  # (K,) rad
    mobility: Array  # (K + 1, K, K): acceleration for a torque, and how that changes with each angle
    drift: Array  # (D, K): acceleration without torque, of `_drifting`

    @classmethod
    def of(
        cls, joints: NDArray[np.intp], q: Array, dq: Array, torque: Array, ddq: Array
    ) -> tuple[Limb, float]:
        """Fitted to rows (N, K), and the share of the acceleration that is left."""
        middle = q.mean(axis=0)
        pushed = np.concatenate([torque, *(torque * one[:, None] for one in (q - middle).T)], axis=1)
        drifting, rubbing = _drifting(q - middle, dq), np.concatenate([dq, np.tanh(dq / 0.05)], axis=1)
        x = np.concatenate([pushed, drifting, rubbing], axis=1)
        size = np.sqrt(np.mean(x * x, axis=0)) + 1e-12
        gram = (x / size).T @ (x / size) + _RIDGE * len(x) * np.eye(x.shape[1])
        solution = np.linalg.solve(gram, (x / size).T @ ddq) / size[:, None]
        left = float(np.sum((ddq - x @ solution) ** 2) / (np.sum((ddq - ddq.mean(axis=0)) ** 2) + 1e-12))
        k, last = len(joints), pushed.shape[1]
        mobility = solution[:last].reshape(k + 1, k, k).transpose(0, 2, 1)
        return cls(joints, middle, mobility, solution[last : last + drifting.shape[1]]), left

    def accelerations(self, q: Array, dq: Array, torque: Array) -> Array:
        """What joints (N, K) at `q`, `dq` do under `torque`, rad/s^2."""
        pushed: Array = (self._mobility(q) @ torque[..., None])[..., 0]
        drift: Array = _drifting(q - self.middle, dq) @ self.drift
        return pushed + drift

    def torques(self, q: Array, dq: Array, ddq: Array) -> Array:
        """The torques (N, K) under which they accelerate so, N m."""
        moved = ddq - _drifting(q - self.middle, dq) @ self.drift
        return np.asarray(np.linalg.solve(self._mobility(q), moved[..., None])[..., 0], dtype=np.float64)

    def _mobility(self, q: Array) -> Array:
        turned: Array = self.mobility[0] + np.einsum("...k,kij->...ij", q - self.middle, self.mobility[1:])
        return turned


def _drifting(q: Array, dq: Array) -> Array:
    """What loads and inertial forces are sums of: 1, angles, and products of angles and of speeds, (N, D)."""
    k = q.shape[1]
    pairs = [(a, b) for a in range(k) for b in range(a, k)]
    columns = [
        np.ones(len(q)),
        *q.T,
        *(q[:, a] * q[:, b] for a, b in pairs),
        *(dq[:, a] * dq[:, b] for a, b in pairs),
    ]
    return np.stack(columns, axis=1)


@attrs.frozen(eq=False)
class Body:
    """All limbs of a robot."""

    limbs: tuple[Limb, ...]

    @property
    def inertia(self) -> Array:
        """What each joint turns in the middle of the motion, the others held, (J,), kg m^2."""
        found = np.zeros(sum(len(limb.joints) for limb in self.limbs))
        for limb in self.limbs:
            found[limb.joints] = np.diagonal(np.linalg.inv(limb.mobility[0]))
        return found

    def torques(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Of all joints, (N, J), N m."""
        found = np.zeros_like(q)
        for limb in self.limbs:
            at = limb.joints
            found[:, at] = limb.torques(q[:, at], dq[:, at], ddq[:, at])
        return found

    def accelerations(self, q: Array, dq: Array, torque: Array) -> Array:
        """Of all joints, (N, J), rad/s^2."""
        found = np.zeros_like(q)
        for limb in self.limbs:
            at = limb.joints
            found[:, at] = limb.accelerations(q[:, at], dq[:, at], torque[:, at])
        return found


def spans(log: Log) -> tuple[Log, Array]:
    """The log in steps of _SPAN, each row the mean over a step, and the accelerations in them (N, J).

    Commands are stamped half a step later, so that their mean over a step from a row on is that over the row's own step.
    """
    count = max(1, round(_SPAN / log.period))
    first = np.arange(0, len(log.t) - count, count)
    last = first + count
    q, dq = np.asarray(log.q, dtype=float), np.asarray(log.dq, dtype=float)
    dt = (log.t[last] - log.t[first])[:, None]
    whole = np.array([log.valid[a : b + 1].all(axis=0) for a, b in zip(first, last, strict=True)])
    whole &= dt < 1.5 * count * log.period
    half = 0.5 * count * log.period
    voltage = None if log.voltage is None else log.voltage[first]
    temperature = None if log.temperature is None else log.temperature[first]
    coarse = attrs.evolve(
        log,
        t=0.5 * (log.t[first] + log.t[last]),
        t_cmd=log.t_cmd + half,
        valid=whole,
        temperature=temperature,
        voltage=voltage,
        tau=None,
        q=_mean(q, first, count),
        dq=_mean(dq, first, count),
    )
    return coarse, (dq[last] - dq[first]) / dt


def _mean(x: Array, first: NDArray[np.intp], count: int) -> Array:
    """Over rows `first` to `first + count`, the outer two for half."""
    rows = [x[first + k] for k in range(count + 1)]
    mean: Array = (0.5 * (rows[0] + rows[-1]) + sum(rows[1:-1], start=np.zeros_like(rows[0]))) / count
    return mean


def implied(log: Log, body: Body | None = None) -> tuple[Log, Body]:
    """The log with the torque that its motion implies, and the body that carries it, fitted unless it is known.

    Raises LogError where the gains are not known: without torque the scale of everything hangs on them.
    """
    if log.kp is None or log.kd is None:
        raise LogError(
            f"{log.name}: tau, kp: both are missing, expected the torque or the gains (--gains KP KD)"
        )
    coarse, ddq = spans(log)
    samples = Samples([coarse])
    if body is None:
        delays = np.arange(0.0, MAX_INPUT_DELAY_S, _DELAY_STEP)
        body = min((_fitted(samples, ddq, delay) for delay in delays), key=lambda one: one[1])[0]
        for joint, inertia in zip(log.joints, body.inertia, strict=True):
            if inertia <= 0.0:
                raise LogError(
                    f"{log.name}: q/{joint}: the motion implies an inertia of {inertia:.3g} kg m^2; expected a joint "
                    "that turns freely (the robot hung in the air), or a measured tau"
                )
    tau = body.torques(*(np.asarray(x, dtype=np.float64) for x in (coarse.q, coarse.dq, ddq)))
    return attrs.evolve(coarse, tau=tau), body


def _fitted(samples: Samples, ddq: Array, delay: float) -> tuple[Body, float]:
    """The body that explains the accelerations best with this delay, and what it leaves of them."""
    s = samples.at(delay, 0.0, samples.period)
    torque = s.kp * (s.q_des - s.q) + s.kd * (s.dq_des - s.dq) + s.tau_ff
    keep = samples.judged.all(axis=1)
    limbs, share = [], 0.0
    for joints in _limbs(samples.joints):
        rows = (x[keep][:, joints] for x in (s.q, s.dq, torque, ddq))
        limb, left = Limb.of(joints, *rows)
        limbs.append(limb)
        share += left * len(joints)
    return Body(tuple(limbs)), share


def _limbs(joints: Sequence[str]) -> list[NDArray[np.intp]]:
    """Joints whose names begin alike, FR_hip_joint and FR_calf_joint; each on its own where these are too many."""
    names = [name.partition("_")[0] for name in joints]
    groups = [np.flatnonzero([one == name for one in names]) for name in dict.fromkeys(names)]
    return [
        part
        for group in groups
        for part in ([group] if len(group) <= _LARGEST else np.split(group, len(group)))
    ]


def replayed(logs: Sequence[Log], parameters: ActuatorParameters, body: Body, rows: Bools) -> Replay:
    """Root mean square errors of q (rad) and dq (rad/s) over `rows` (N, J) of all logs, replaying STRETCH at a time."""
    errors = np.concatenate([_replay(log, parameters, body) for log in logs], axis=1)
    count = max(int(rows.sum()), 1)
    sizes = np.sqrt(np.sum(np.where(rows, errors, 0.0) ** 2, axis=(1, 2)) / count)
    return {"q_rms_rad": float(sizes[0]), "dq_rms_rad_s": float(sizes[1])}


def _replay(log: Log, parameters: ActuatorParameters, body: Body) -> Array:
    """Errors (2, N, J) of q and dq."""
    count = max(1, int(np.ceil(log.period / _STEP - 1e-9)))
    dt = log.period / count
    model = ActuatorModel(attrs.evolve(parameters, torque_noise=0.0), (len(log.joints),), dt)
    packets = log.command_rows((log.t[:, None] + 0.5 * log.period + dt * np.arange(count)).ravel()).reshape(
        -1, count
    )
    none = np.zeros(log.q_des.shape)
    kp, kd, dq_des, tau_ff = (
        none if x is None else np.asarray(x) for x in (log.kp, log.kd, log.dq_des, log.tau_ff)
    )
    q, dq = np.asarray(log.q, dtype=float), np.asarray(log.dq, dtype=float)
    errors = np.zeros((2, *log.q.shape))
    every = max(2, round(STRETCH / log.period))
    after_gap = log.after_gap
    place, speed = q[0], dq[0]
    for n, commands in enumerate(packets):
        if n % every == 0 or after_gap[n]:
            place, speed = q[n], dq[n]
        errors[:, n] = place - q[n], speed - dq[n]
        for row in commands:
            torque = model.step(place, speed, log.q_des[row], kp[row], kd[row], dq_des[row], tau_ff[row])
            speed = speed + dt * body.accelerations(place[None], speed[None], torque[None])[0]
            place = place + dt * speed
    return errors
