"""Empirical actuator model: joint torque for a PD command (Eq. 1 and 2 of the paper).

    command packet -> input delay t_i -> PD law -> effects -> clip -> output delay t_o
                   -> effects at the joint -> + noise -> clip -> torque on the joint

    PD law: tau* = kp_hat (q_des - q) + kd_hat (dq_des - dq) + tau_ff

The command is held between its updates; the PD law is evaluated in every step on the present joint
state. The simulator, the batched training and the identification share this model.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.delay import DelayLine
from quadvel_actuator.parameters import ActuatorParameters
from quadvel_actuator.running import RunningEffects
from quadvel_description.arrays import Array
from quadvel_description.quadruped import JOINT_NAMES

Values = float | Array

_NOISE_BLOCK_SAMPLES = 16384  # drawn at a time


def _per_joint(field: str, value: float | tuple[float, ...], joints: int) -> Array:
    """Expand one number, three (hip, thigh, calf) or one per joint to an array (joints,)."""
    values = np.atleast_1d(np.asarray(value, dtype=float))
    if values.size == 3 and joints % 3 == 0:
        values = np.tile(values, joints // 3)
    if values.size not in (1, joints):
        raise ValueError(f"{field}: found {values.size} numbers, expected 1 or {joints}")
    return np.broadcast_to(values, (joints,)).copy()


def _is_zero(value: Values) -> bool:
    """Whether a value is the scalar 0, so that its term can be skipped."""
    return isinstance(value, (int, float)) and value == 0


def _is_identical(given: Values, held: Array) -> bool:
    """Compare bit by bit; for the joints of one robot this is much faster than np.array_equal."""
    return np.asarray(given, dtype=float).tobytes() == held.tobytes()


class ActuatorModel:
    """Empirical actuator model of the joints of one robot or of a batch of robots.

    The gain deviation is relative: kp_hat = kp (1 + delta_kp / kp_ref), which is Eq. 2 at the
    reference gains. Two models with the same parameters, shape, seed and calls give the same
    torques bit for bit.

    `input_delay`, `output_delay`, `kp_scale`, `kd_scale` and `noise_std` return copies. Assign a
    whole array that broadcasts to their shape, so that each environment may differ. Call `reset`
    after a change of the gain scales: a command under way keeps the old ones.

    Attributes:
        parameters: parameters that the model was built from.
        shape: shape of all joint arrays, (J,) or (N, J).
        dt: s, duration of a step.
    """

    def __init__(
        self, parameters: ActuatorParameters, shape: tuple[int, ...] = (12,), dt: float = 0.001, seed: int = 0
    ) -> None:
        """Create a model without a past.

        Args:
            parameters: parameters of the actuators.
            shape: (J,) for one robot, (N, J) for a batch.
            dt: s, duration of a step.
            seed: seed of the torque noise, of random effects, and of `sample` without a generator.

        Raises:
            ValueError: the parameters are for another number of joints, or an effect cannot run.
        """
        self.parameters = parameters
        self.shape = shape
        self.dt = dt
        self._rng = np.random.default_rng(seed)
        joints = shape[-1]
        if parameters.joints and len(parameters.joints) != joints:  # else 3 of 12 pass as hip, thigh, calf
            found = f"{len(parameters.joints)} names ({', '.join(parameters.joints)})"
            raise ValueError(f"actuator {parameters.name}: joints: found {found}, expected {joints}")
        limit = _per_joint("torque_limit", parameters.torque_limit, joints)
        self._limit = np.broadcast_to(limit, shape).copy()
        self._floor = -self._limit
        self._kp_deviation = _per_joint("delta_kp", parameters.delta_kp, joints) / parameters.kp_ref
        self._kd_deviation = _per_joint("delta_kd", parameters.delta_kd, joints) / parameters.kd_ref

        self._packets = DelayLine(shape, dt)  # kp_hat q_des + kd_hat dq_des + tau_ff
        self._gains = DelayLine((*shape[:-1], 2 * joints), dt)  # kp, kd; used while a change is under way
        self._torques = DelayLine(shape, dt)  # torque of the drive
        self._effects = self._running_effects(seed)
        self._noise = np.zeros((0, *shape), dtype=np.float32)
        self._noise_used = 0
        self._scratch = np.zeros(shape)

        self._kp: Array | None = None  # as last commanded
        self._kd: Array | None = None
        self._kp_scale = self._kd_scale = np.ones(shape)
        self.input_delay = parameters.best_pair.input_delay_s
        self.output_delay = parameters.best_pair.output_delay_s
        self.kp_scale = 1.0 + self._kp_deviation
        self.kd_scale = 1.0 + self._kd_deviation
        self.noise_std = np.sqrt(parameters.torque_noise)
        self._new = np.ones(shape[:-1], dtype=bool)
        self.reset()

    def _running_effects(self, seed: int) -> RunningEffects | None:
        """Build the effects of the model; None without effects, to save time per step."""
        parameters = self.parameters
        if not parameters.effects:
            return None
        names = parameters.joints or JOINT_NAMES
        try:
            return RunningEffects(parameters.effects, names, self.shape, self.dt, seed)
        except ValueError as error:
            raise ValueError(f"actuator {parameters.name}: {error}") from None

    @property
    def input_delay(self) -> Array:
        """Delay t_i of the command on its way to the drive, s, (..., 1)."""
        return self._packets.delay

    @input_delay.setter
    def input_delay(self, seconds: Values) -> None:
        """Set the delay of commands, gains and the targets that effects see.

        Args:
            seconds: s, broadcast to (..., 1), at most `delay.MAX_DELAY_S`.
        """
        self._packets.delay = seconds
        self._gains.delay = seconds
        if self._effects is not None:
            self._effects.targets.delay = seconds

    @property
    def output_delay(self) -> Array:
        """Delay t_o from the drive's torque to the torque on the joint, s, (..., 1)."""
        return self._torques.delay

    @output_delay.setter
    def output_delay(self, seconds: Values) -> None:
        """Set the delay of the torque.

        Args:
            seconds: s, broadcast to (..., 1), at most `delay.MAX_DELAY_S`.
        """
        self._torques.delay = seconds

    @property
    def kp_scale(self) -> Array:
        """Ratio of real to commanded proportional gain, kp_hat / kp, (..., J)."""
        return self._kp_scale.copy()

    @kp_scale.setter
    def kp_scale(self, scale: Values) -> None:
        """Set the ratio and update the gains in force.

        Args:
            scale: ratio, broadcast to (..., J).
        """
        self._kp_scale = np.broadcast_to(scale, self.shape).astype(float)
        self._update_gains()

    @property
    def kd_scale(self) -> Array:
        """Ratio of real to commanded derivative gain, kd_hat / kd, (..., J)."""
        return self._kd_scale.copy()

    @kd_scale.setter
    def kd_scale(self, scale: Values) -> None:
        """Set the ratio and update the gains in force.

        Args:
            scale: ratio, broadcast to (..., J).
        """
        self._kd_scale = np.broadcast_to(scale, self.shape).astype(float)
        self._update_gains()

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the torque noise, N m, (..., J)."""
        return self._noise_std.copy()

    @noise_std.setter
    def noise_std(self, std: Values) -> None:
        """Set the standard deviation of the torque noise.

        Args:
            std: N m, broadcast to (..., J).
        """
        self._noise_std = np.broadcast_to(std, self.shape).astype(float)
        self._noisy = bool(self._noise_std.any())

    def sample(self, ids: Any = None, rng: np.random.Generator | None = None) -> None:
        """Draw delays, gains and effects at random, as Section 3.1 of the paper randomises them.

        Call `reset(ids)` afterwards.

        Args:
            ids: index of the environments, all by default.
            rng: source of randomness, the model's own by default.
        """
        where = ... if ids is None else ids
        rng = self._rng if rng is None else rng
        probable = self.parameters.probable_pairs
        pairs = np.array([(pair.input_delay_s, pair.output_delay_s) for pair in probable])
        input_delay, output_delay = self.input_delay, self.output_delay
        kp_scale, kd_scale = self.kp_scale, self.kd_scale
        count = input_delay[where].shape
        # Uniform and independent between environments:
        #     (t_i, t_o) one of the probable pairs
        #     kp_hat / kp = 1 + 2 u delta_kp / kp_ref, u in [0, 1], so kp_hat in [kp + 2 delta_kp,
        #     kp]
        #     kd_hat / kd likewise; all joints of an environment share u
        drawn = pairs[rng.integers(len(pairs), size=count)]
        input_delay[where], output_delay[where] = drawn[..., 0], drawn[..., 1]
        kp_scale[where] = 1.0 + 2.0 * rng.random(count) * self._kp_deviation
        kd_scale[where] = 1.0 + 2.0 * rng.random(count) * self._kd_deviation
        self.input_delay, self.output_delay = input_delay, output_delay
        self.kp_scale, self.kd_scale = kp_scale, kd_scale
        if self._effects is not None:
            self._effects.sample(where, rng, self.shape)

    def reset(self, ids: Any = None) -> None:
        """Clear the past of some environments.

        The next command counts as constant for all earlier times, and so does its torque: empty
        buffers cause no jump. The noise sequence continues.

        Args:
            ids: index of the environments, all by default.
        """
        self._new[... if ids is None else ids] = True
        self._any_new = True
        if ids is None:
            self._kp = self._kd = None
            self._gain_age = self._gains.length

    def step(
        self,
        q: Array,
        dq: Array,
        q_des: Array,
        kp: Values,
        kd: Values,
        dq_des: Values = 0.0,
        tau_ff: Values = 0.0,
    ) -> Array:
        """Advance by one step and compute the torque.

        Arrays are of `shape` or broadcast to it.

        Args:
            q: rad, present joint positions.
            dq: rad/s, present joint velocities.
            q_des: rad, position target sent now.
            kp: N m/rad, proportional gain sent now.
            kd: N m s/rad, derivative gain sent now.
            dq_des: rad/s, velocity target sent now.
            tau_ff: N m, feedforward torque sent now.

        Returns:
            N m, mean torque over the next `dt`, a new array of `shape`.
        """
        # Eq. 1: tau(t) = tau*(t - t_o) + noise, where tau* uses the command of t - t_i. Effects at
        # the
        # joint act after the output delay.
        self._push_command(q_des, kp, kd, dq_des, tau_ff)
        asked = self._torques.push()
        self._pd_torque(q, dq, out=asked)
        new = self._new if self._any_new else None
        if new is not None:
            self._torques.fill_history(new)
        torque = self._torques.read()
        if self._effects is not None:
            torque = self._effects.joint_torque(torque, new)
        if new is not None:
            new[...] = False
            self._any_new = False
        if self._noisy:
            torque += np.multiply(self._noise_std, self._next_noise(), out=self._scratch)
            self._clip(torque, out=torque)
        return torque

    def peek(
        self,
        q: Array,
        dq: Array,
        q_des: Array,
        kp: Values,
        kd: Values,
        dq_des: Values = 0.0,
        tau_ff: Values = 0.0,
    ) -> Array:
        """Return the torque that `step` would return now, without advancing the model.

        This samples the torque at the instant of `q` and `dq`, before the controller has answered
        them.

        Args:
            q: rad, present joint positions.
            dq: rad/s, present joint velocities.
            q_des: rad, position target.
            kp: N m/rad, proportional gain.
            kd: N m s/rad, derivative gain.
            dq_des: rad/s, velocity target.
            tau_ff: N m, feedforward torque.

        Returns:
            N m, an array of `shape`.
        """
        # Take a step, then restore everything that the step changed.
        lines = (self._packets, self._gains, self._torques)
        heads = [line.head for line in lines]
        memory = self._kp, self._kd, self._gain_age, self._any_new
        new = self._new.copy()
        kept = None if self._effects is None else self._effects.save_memory()
        torque = self.step(q, dq, q_des, kp, kd, dq_des, tau_ff)
        for line, head in zip(lines, heads, strict=True):
            line.head = head  # slots written since held samples too old to be read
        self._kp, self._kd, self._gain_age, self._any_new = memory
        self._new[...] = new
        if self._effects is not None:
            self._effects.restore_memory(kept)
        self._update_gains()
        if self._noisy:
            self._noise_used -= 1
        return torque

    def _push_command(self, q_des: Array, kp: Values, kd: Values, dq_des: Values, tau_ff: Values) -> None:
        """Push the command packet into its delay line and, while gains change, the gains."""
        self._note_gains(kp, kd)
        # Everything in tau* that does not depend on the joint state travels as one number:
        #     packet = kp_hat q_des + kd_hat dq_des + tau_ff
        packet = self._packets.push()
        np.multiply(self._kp_hat, q_des, out=packet)
        if not _is_zero(dq_des):
            packet += self._kd_hat * dq_des
        if not _is_zero(tau_ff):
            packet += tau_ff
        if self._any_new:
            self._packets.fill_history(self._new)
        if self._effects is not None:
            self._effects.push_targets(q_des, dq_des, self._new if self._any_new else None)

    def _note_gains(self, kp: Values, kd: Values) -> None:
        """Record the commanded gains; keep their history until a change has passed the delay."""
        if self._kp is None or self._kd is None:
            self._set_gains(kp, kd)
        elif not (_is_identical(kp, self._kp) and _is_identical(kd, self._kd)):
            if self._gain_age >= self._gains.length:  # start the history with the gains in force
                self._store_gains(self._gains.push())
                self._gains.fill_history(...)
            self._gain_age = 0
            self._set_gains(kp, kd)
        if self._gain_age < self._gains.length:
            self._gain_age += 1
            self._store_gains(self._gains.push())
            if self._any_new:
                self._gains.fill_history(self._new)

    def _set_gains(self, kp: Values, kd: Values) -> None:
        """Store new commanded gains and update the gains in force."""
        self._kp, self._kd = np.array(kp, dtype=float), np.array(kd, dtype=float)
        self._update_gains()

    def _store_gains(self, slot: Array) -> None:
        """Write kp and kd side by side into a slot (..., 2 J)."""
        joints = self.shape[-1]
        slot[..., :joints] = self._kp
        slot[..., joints:] = self._kd

    def _update_gains(self) -> None:
        """Compute kp_hat and kd_hat of the commanded gains."""
        if self._kp is not None and self._kd is not None:
            self._kp_hat = self._kp_scale * self._kp
            self._kd_hat = self._kd_scale * self._kd

    def _pd_torque(self, q: Array, dq: Array, out: Array) -> None:
        """Compute the clipped torque of the drive: the bracket of Eq. 1, with effects."""
        kp_hat, kd_hat = self._kp_hat, self._kd_hat
        if self._gain_age < self._gains.length:
            gains = self._gains.read()
            joints = self.shape[-1]
            kp_hat, kd_hat = self._kp_scale * gains[..., :joints], self._kd_scale * gains[..., joints:]
        # tau* = packet(t - t_i) - kp_hat(t - t_i) q(t) - kd_hat(t - t_i) dq(t)
        torque = self._packets.read()
        torque -= np.multiply(kp_hat, q, out=self._scratch)
        torque -= np.multiply(kd_hat, dq, out=self._scratch)
        if self._effects is not None:
            torque = self._effects.drive_torque(
                torque, q, dq, kp_hat, kd_hat, self._new if self._any_new else None
            )
        self._clip(torque, out=out)

    def _clip(self, torque: Array, out: Array) -> None:
        """Clip a torque to the limit of each joint."""
        np.minimum(torque, self._limit, out=out)
        np.maximum(out, self._floor, out=out)

    def _next_noise(self) -> NDArray[np.float32]:
        """Return standard normal numbers for one step; blocks save the cost of calls."""
        if self._noise_used == len(self._noise):
            steps = max(1, _NOISE_BLOCK_SAMPLES // int(np.prod(self.shape)))
            self._noise = self._rng.standard_normal((steps, *self.shape), dtype=np.float32)
            self._noise_used = 0
        self._noise_used += 1
        noise: NDArray[np.float32] = self._noise[self._noise_used - 1]
        return noise
