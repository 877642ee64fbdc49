"""Identification without measured torque: from the motion of limbs that touch nothing.

Accelerations are linear in the torques and in a load that depends on angles and speeds. Inertia and
load are fitted together with the torques of the PD law and of friction. The torque that the motion then implies
replaces the measured one, and the same identification runs on it. Its scale is that of the
commanded gains. The improvement is stated in rad and rad/s, from a replay of the commands over
short stretches. There is no model of contacts: the robot has to be suspended.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import attrs
import numpy as np

from quadvel_actuator.model import ActuatorModel
from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description.arrays import Array, Bools, Indices

from ..logs.log import Log, LogError
from .plain_model import MAX_INPUT_DELAY_S
from .signals import Samples

_AVERAGING_S = 0.008
"""s over which an acceleration is computed; encoders are too coarse for less."""
_DELAY_STEP_S = 0.0005
"""s between the delays that are tried."""
_MAX_STEP_S = 0.001
"""s; longest time step of the replay."""
_MAX_LIMB_JOINTS = 4
"""Largest number of joints that are fitted together as one limb; larger groups are split into joints."""
_RIDGE = 1e-5
"""Ridge penalty on the regression's normalised weights, times the number of rows."""


@attrs.frozen(eq=False)
class Limb:
    """Dynamics of K joints that carry each other, linear about the middle of the motion.

        ddq = (B_0 + sum_k (q_k - middle_k) B_k) tau + drift^T phi(q - middle, dq)

    with the regressors phi of `_load_regressors`.

    Attributes:
        joints: (K,) indices of the joints.
        middle: (K,) mean angles, rad.
        mobility: (K + 1, K, K) matrices B_0, B_1, ..., B_K, 1/(kg m^2), the latter per rad.
        drift: (D, K) weights of the acceleration without torque.
    """

    joints: Indices
    middle: Array
    mobility: Array
    drift: Array

    @classmethod
    def fit(cls, joints: Indices, q: Array, dq: Array, torque: Array, ddq: Array) -> tuple[Limb, float]:
        """Fit the dynamics to a motion.

        Args:
            joints: (K,) indices of the joints.
            q: (N, K) angles, rad.
            dq: (N, K) speeds, rad/s.
            torque: (N, K) torques of the PD law, N m.
            ddq: (N, K) accelerations, rad/s^2.

        Returns:
            The limb, and the share of the acceleration's variance that is left.
        """
        middle = q.mean(axis=0)
        # Regress ddq on [tau, (q_k - middle_k) tau, phi(q - middle, dq), dq, tanh(dq / 0.05)] with a
        # ridge penalty on normalised columns; the last two, friction, stay out of the dynamics.
        torque_terms = np.concatenate([torque, *(torque * one[:, None] for one in (q - middle).T)], axis=1)
        load_terms, friction_terms = (
            _load_regressors(q - middle, dq),
            np.concatenate([dq, np.tanh(dq / 0.05)], axis=1),
        )
        x = np.concatenate([torque_terms, load_terms, friction_terms], axis=1)
        size = np.sqrt(np.mean(x * x, axis=0)) + 1e-12
        gram = (x / size).T @ (x / size) + _RIDGE * len(x) * np.eye(x.shape[1])
        solution = np.linalg.solve(gram, (x / size).T @ ddq) / size[:, None]
        left = float(np.sum((ddq - x @ solution) ** 2) / (np.sum((ddq - ddq.mean(axis=0)) ** 2) + 1e-12))
        k, last = len(joints), torque_terms.shape[1]
        mobility = solution[:last].reshape(k + 1, k, k).transpose(0, 2, 1)
        return cls(joints, middle, mobility, solution[last : last + load_terms.shape[1]]), left

    def accelerations(self, q: Array, dq: Array, torque: Array) -> Array:
        """Compute forward dynamics.

        Args:
            q: (N, K) angles, rad.
            dq: (N, K) speeds, rad/s.
            torque: (N, K) torques, N m.

        Returns:
            (N, K) accelerations, rad/s^2.
        """
        torque_terms: Array = (self._mobility(q) @ torque[..., None])[..., 0]
        drift: Array = _load_regressors(q - self.middle, dq) @ self.drift
        return torque_terms + drift

    def torques(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Compute inverse dynamics.

        Args:
            q: (N, K) angles, rad.
            dq: (N, K) speeds, rad/s.
            ddq: (N, K) accelerations, rad/s^2.

        Returns:
            (N, K) torques, N m.
        """
        driven = ddq - _load_regressors(q - self.middle, dq) @ self.drift
        return np.asarray(np.linalg.solve(self._mobility(q), driven[..., None])[..., 0], dtype=np.float64)

    def _mobility(self, q: Array) -> Array:
        """Mobility (..., K, K) at angles q (..., K)."""
        turned: Array = self.mobility[0] + np.einsum("...k,kij->...ij", q - self.middle, self.mobility[1:])
        return turned


def _load_regressors(q: Array, dq: Array) -> Array:
    """Regressors (N, D) of loads and inertial forces: 1, q, products of q, products of dq."""
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
    """Dynamics of all limbs of a robot.

    Attributes:
        limbs: The limbs, which do not affect each other.
    """

    stretch_s: ClassVar = 0.05
    """s that are replayed from a measured state before the next one is used."""

    limbs: tuple[Limb, ...]

    @property
    def inertia(self) -> Array:
        """Inertia (J,) of each joint in the middle of the motion, the other joints fixed, kg m^2."""
        found = np.zeros(sum(len(limb.joints) for limb in self.limbs))
        for limb in self.limbs:
            found[limb.joints] = np.diagonal(np.linalg.inv(limb.mobility[0]))
        return found

    def torques(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Compute inverse dynamics of all joints.

        Args:
            q: (N, J) angles, rad.
            dq: (N, J) speeds, rad/s.
            ddq: (N, J) accelerations, rad/s^2.

        Returns:
            (N, J) torques, N m.
        """
        found = np.zeros_like(q)
        for limb in self.limbs:
            at = limb.joints
            found[:, at] = limb.torques(q[:, at], dq[:, at], ddq[:, at])
        return found

    def accelerations(self, q: Array, dq: Array, torque: Array) -> Array:
        """Compute forward dynamics of all joints.

        Args:
            q: (N, J) angles, rad.
            dq: (N, J) speeds, rad/s.
            torque: (N, J) torques, N m.

        Returns:
            (N, J) accelerations, rad/s^2.
        """
        found = np.zeros_like(q)
        for limb in self.limbs:
            at = limb.joints
            found[:, at] = limb.accelerations(q[:, at], dq[:, at], torque[:, at])
        return found

    def replay_errors(
        self, logs: Sequence[Log], parameters: ActuatorParameters, rows: Bools
    ) -> dict[str, Any]:
        """Replay the commands of logs and compute the root mean square deviations.

        Args:
            logs: Averaged logs, from `imply_torque`.
            parameters: The actuator model.
            rows: (N, J) rows of all logs that count.

        Returns:
            Deviations of angles (rad) and speeds (rad/s): `q_rms_rad` and `dq_rms_rad_s`.
        """
        errors = np.concatenate([_replay_log(log, parameters, self) for log in logs], axis=1)
        count = max(int(rows.sum()), 1)
        sizes = np.sqrt(np.sum(np.where(rows, errors, 0.0) ** 2, axis=(1, 2)) / count)
        return {"q_rms_rad": float(sizes[0]), "dq_rms_rad_s": float(sizes[1])}

    def report_section(self, before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
        """Build the section of report.json on the replay.

        Args:
            before: Replay errors of the plain EAM.
            after: Replay errors of the corrected model.

        Returns:
            The section by its name.
        """
        return {
            "motion": {
                "inertia": {"value": self.inertia.tolist(), "unit": "kg m^2"},
                "replayed_s": self.stretch_s,
                "text": "No torque was logged. It is inferred from the motion, so that the inertia includes that of the rotor, "
                "and a bias of an encoder appears as a torque offset.",
                "before": before,
                "after": after,
            }
        }


def average_over_steps(log: Log) -> tuple[Log, Array]:
    """Average a log over steps of `_AVERAGING_S` and compute the accelerations in them.

    The times of rows move to the middle of their step, and those of commands by the same half step.

    Args:
        log: The log.

    Returns:
        The averaged log with N rows, without torque, and (N, J) accelerations, rad/s^2.
    """
    count = max(1, round(_AVERAGING_S / log.period))
    first = np.arange(0, len(log.t) - count, count)
    last = first + count
    q, dq = np.asarray(log.q, dtype=float), np.asarray(log.dq, dtype=float)
    dt = (log.t[last] - log.t[first])[:, None]
    whole = np.array([log.valid[a : b + 1].all(axis=0) for a, b in zip(first, last, strict=True)])
    whole &= dt < 1.5 * count * log.period
    half = 0.5 * count * log.period
    coarse = attrs.evolve(
        log,
        t=0.5 * (log.t[first] + log.t[last]),
        t_cmd=log.t_cmd + half,
        valid=whole,
        temperature=None if log.temperature is None else log.temperature[first],
        voltage=None if log.voltage is None else log.voltage[first],
        tau=None,
        q=_trapezoid_mean(q, first, count),
        dq=_trapezoid_mean(dq, first, count),
    )
    return coarse, (dq[last] - dq[first]) / dt


def _trapezoid_mean(x: Array, first: Indices, count: int) -> Array:
    """Mean over rows `first` to `first + count`, the outer two with half weight."""
    rows = [x[first + k] for k in range(count + 1)]
    mean: Array = (0.5 * (rows[0] + rows[-1]) + sum(rows[1:-1], start=np.zeros_like(rows[0]))) / count
    return mean


def imply_torque(log: Log, body: Body | None = None) -> tuple[Log, Body]:
    """Compute the torque that a log's motion implies.

    Args:
        log: The log, with gains.
        body: The dynamics, if known; else they are fitted to the log.

    Returns:
        The averaged log with the implied torque, and the dynamics.

    Raises:
        LogError: The gains are missing, or the motion implies a negative inertia.
    """
    if log.kp is None or log.kd is None:
        raise LogError(
            f"{log.name}: tau, kp: both are missing, expected the torque or the gains (--gains KP KD)"
        )
    coarse, ddq = average_over_steps(log)
    samples = Samples.of([coarse])
    if body is None:
        delays = np.arange(0.0, MAX_INPUT_DELAY_S, _DELAY_STEP_S)
        body = min((_fit_body(samples, ddq, delay) for delay in delays), key=lambda one: one[1])[0]
        for joint, inertia in zip(log.joints, body.inertia, strict=True):
            if inertia <= 0.0:
                raise LogError(
                    f"{log.name}: q/{joint}: the motion implies an inertia of {inertia:.3g} kg m^2; expected a joint "
                    "that turns freely (the robot suspended in the air), or a measured tau"
                )
    tau = body.torques(*(np.asarray(x, dtype=np.float64) for x in (coarse.q, coarse.dq, ddq)))
    return attrs.evolve(coarse, tau=tau), body


def _fit_body(samples: Samples, ddq: Array, delay: float) -> tuple[Body, float]:
    """Fit all limbs at one input delay; also return the sum of the variance shares that are left."""
    s = samples.at(delay, 0.0, samples.period)
    torque = s.kp * (s.q_des - s.q) + s.kd * (s.dq_des - s.dq) + s.tau_ff
    keep = samples.evaluated.all(axis=1)
    limbs, share = [], 0.0
    for joints in _group_limbs(samples.joints):
        rows = (x[keep][:, joints] for x in (s.q, s.dq, torque, ddq))
        limb, left = Limb.fit(joints, *rows)
        limbs.append(limb)
        share += left * len(joints)
    return Body(tuple(limbs)), share


def _group_limbs(joints: Sequence[str]) -> list[Indices]:
    """Group joints with the same first part of the name, and split groups that are too large."""
    names = [name.partition("_")[0] for name in joints]
    groups = [np.flatnonzero([one == name for one in names]) for name in dict.fromkeys(names)]
    return [
        part
        for group in groups
        for part in ([group] if len(group) <= _MAX_LIMB_JOINTS else np.split(group, len(group)))
    ]


def _replay_log(log: Log, parameters: ActuatorParameters, body: Body) -> Array:
    """Deviations (2, N, J) of q and dq in the replay of one log."""
    count = max(1, int(np.ceil(log.period / _MAX_STEP_S - 1e-9)))
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
    # Semi-implicit Euler steps of the fitted dynamics under the model's torque. Every stretch, and
    # after a gap, the state is set to the measured one.
    errors = np.zeros((2, *log.q.shape))
    every = max(2, round(body.stretch_s / log.period))
    after_gap = log.after_gap
    angle, speed = q[0], dq[0]
    for n, commands in enumerate(packets):
        if n % every == 0 or after_gap[n]:
            angle, speed = q[n], dq[n]
        errors[:, n] = angle - q[n], speed - dq[n]
        for row in commands:
            torque = model.step(angle, speed, log.q_des[row], kp[row], kd[row], dq_des[row], tau_ff[row])
            speed = speed + dt * body.accelerations(angle[None], speed[None], torque[None])[0]
            angle = angle + dt * speed
    return errors
