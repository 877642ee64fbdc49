"""The empirical actuator model: what torque the joints give for a PD command (Eq. 1 and 2 of the paper).

    command packet --input delay--> asked torque = kp_hat (q_des - q) + kd_hat (dq_des - dq) + tau_ff
    asked torque --effects, if the parameters hold any--> clipped
    asked torque --output delay--> + effects at the joint + noise, clipped = torque on the joint

The law is evaluated every step on the present joint state, with the command held between its updates. One
model serves the simulator, the batch training and the identification.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.delay import DelayLine
from quadvel_actuator.parameters import ActuatorParameters
from quadvel_actuator.running import RunningEffects
from quadvel_description.robot import JOINT_NAMES

Array = NDArray[np.float64]
Values = float | Array

_NOISE_BLOCK = 16384  # samples drawn at once


def _per_joint(field: str, value: float | tuple[float, ...], joints: int) -> Array:
    """A number, one for each of hip, thigh and calf, or one for each joint, as an array (joints,)."""
    values = np.atleast_1d(np.asarray(value, dtype=float))
    if values.size == 3 and joints % 3 == 0:
        values = np.tile(values, joints // 3)
    if values.size not in (1, joints):
        raise ValueError(f"{field}: found {values.size} numbers, expected 1 or {joints}")
    return np.broadcast_to(values, (joints,)).copy()


def _is_zero(value: Values) -> bool:
    return isinstance(value, (int, float)) and value == 0


def _same(given: Values, held: Array) -> bool:
    """Equal to the bit; for the joints of one robot much faster than np.array_equal."""
    return np.asarray(given, dtype=float).tobytes() == held.tobytes()


class ActuatorModel:
    """The joints of one robot, shape (12,), or of a batch of them, (N, 12); one `step` covers `dt` seconds.

    `input_delay`, `output_delay` (s), shape (..., 1), and `kp_scale`, `kd_scale` (1), `noise_std` (N m),
    shape (..., J), are read as copies and set as wholes with anything that broadcasts to these shapes, so
    that each environment may differ. Change gain scales together with `reset`: a command under way keeps the
    old ones.

    The gain deviation is relative, kp_hat = kp (1 + delta_kp / kp_ref), Eq. 2 at the reference gains. Two
    models with the same parameters, shape, seed and calls give the same torques bit for bit.
    """

    def __init__(
        self, parameters: ActuatorParameters, shape: tuple[int, ...] = (12,), dt: float = 0.001, seed: int = 0
    ) -> None:
        self.parameters = parameters
        self.shape = shape
        self.dt = dt
        self._rng = np.random.default_rng(seed)
        joints = shape[-1]
        limit = _per_joint("torque_limit", parameters.torque_limit, joints)
        self._limit = np.broadcast_to(limit, shape).copy()
        self._floor = -self._limit
        self._kp_deviation = _per_joint("delta_kp", parameters.delta_kp, joints) / parameters.kp_ref
        self._kd_deviation = _per_joint("delta_kd", parameters.delta_kd, joints) / parameters.kd_ref

        self._packets = DelayLine(shape, dt)  # kp_hat q_des + kd_hat dq_des + tau_ff
        self._gains = DelayLine((*shape[:-1], 2 * joints), dt)  # kp, kd; used while a change is under way
        self._torques = DelayLine(shape, dt)  # asked torque
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
        """None where there are none: a model without effects costs no step more."""
        parameters = self.parameters
        if not parameters.effects:
            return None
        names = parameters.joints or JOINT_NAMES
        if len(names) != self.shape[-1]:
            raise ValueError(
                f"actuator {parameters.name}: joints: found {len(names)} names, expected {self.shape[-1]}"
            )
        try:
            return RunningEffects(parameters.effects, names, self.shape, self.dt, seed)
        except ValueError as error:
            raise ValueError(f"actuator {parameters.name}: {error}") from None

    @property
    def input_delay(self) -> Array:
        """Delay of the command on its way to the actuator (s), t_i."""
        return self._packets.delay

    @input_delay.setter
    def input_delay(self, seconds: Values) -> None:
        self._packets.delay = seconds
        self._gains.delay = seconds
        if self._effects is not None:
            self._effects.targets.delay = seconds

    @property
    def output_delay(self) -> Array:
        """Delay from the asked torque to the torque on the joint (s), t_o."""
        return self._torques.delay

    @output_delay.setter
    def output_delay(self, seconds: Values) -> None:
        self._torques.delay = seconds

    @property
    def kp_scale(self) -> Array:
        """Real over commanded proportional gain."""
        return self._kp_scale.copy()

    @kp_scale.setter
    def kp_scale(self, scale: Values) -> None:
        self._kp_scale = np.broadcast_to(scale, self.shape).astype(float)
        self._update_gains()

    @property
    def kd_scale(self) -> Array:
        """Real over commanded derivative gain."""
        return self._kd_scale.copy()

    @kd_scale.setter
    def kd_scale(self, scale: Values) -> None:
        self._kd_scale = np.broadcast_to(scale, self.shape).astype(float)
        self._update_gains()

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the torque noise (N m)."""
        return self._noise_std.copy()

    @noise_std.setter
    def noise_std(self, std: Values) -> None:
        self._noise_std = np.broadcast_to(std, self.shape).astype(float)
        self._noisy = bool(self._noise_std.any())

    def sample(self, ids: Any = None, rng: np.random.Generator | None = None) -> None:
        """Draw delays and gains of the environments `ids` (all by default) as Section 3.1 randomises them.

        A probable pair of delays, kp in [kp + 2 delta_kp, kp] and kd in [kd + 2 delta_kd, kd], uniform,
        independent between environments, the same share of the deviation for all joints of one; the parameters
        of effects within their intervals. Follow it with `reset(ids)`.
        """
        where = ... if ids is None else ids
        rng = self._rng if rng is None else rng
        probable = self.parameters.probable_pairs
        pairs = np.array([(pair.input_delay_s, pair.output_delay_s) for pair in probable])
        input_delay, output_delay = self.input_delay, self.output_delay
        kp_scale, kd_scale = self.kp_scale, self.kd_scale
        count = input_delay[where].shape
        drawn = pairs[rng.integers(len(pairs), size=count)]
        input_delay[where], output_delay[where] = drawn[..., 0], drawn[..., 1]
        kp_scale[where] = 1.0 + 2.0 * rng.random(count) * self._kp_deviation
        kd_scale[where] = 1.0 + 2.0 * rng.random(count) * self._kd_deviation
        self.input_delay, self.output_delay = input_delay, output_delay
        self.kp_scale, self.kd_scale = kp_scale, kd_scale
        if self._effects is not None:
            self._effects.sample(where, rng, self.shape)

    def reset(self, ids: Any = None) -> None:
        """Forget the past of the environments `ids` (all by default).

        Their next command counts as held since ever, and so does the torque that it asks for: no step of
        torque out of empty buffers. The noise goes on where it is.
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
        """The mean torque (N m) of the next `dt`, a new array of `shape`.

        `q`, `dq`: the present joint state (rad, rad/s); the rest is the command as sent now: `q_des` (rad),
        `dq_des` (rad/s), `tau_ff` (N m), `kp` (N m/rad), `kd` (N m s/rad), of `shape` or broadcast to it.
        """
        self._take_command(q_des, kp, kd, dq_des, tau_ff)
        asked = self._torques.push()
        self._asked_torque(q, dq, out=asked)
        new = self._new if self._any_new else None
        if new is not None:
            self._torques.hold(new)
        torque = self._torques.read()
        if self._effects is not None:
            torque = self._effects.at_joint(torque, new)
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
        """What `step` would return now, time standing still: memory and noise stay where they are.

        A sample of the torque at the very instant of `q` and `dq`, before the command that answers this
        sample is there.
        """
        lines = (self._packets, self._gains, self._torques)
        heads = [line.head for line in lines]
        memory = self._kp, self._kd, self._gain_age, self._any_new
        new = self._new.copy()
        kept = None if self._effects is None else self._effects.remember()
        torque = self.step(q, dq, q_des, kp, kd, dq_des, tau_ff)
        for line, head in zip(lines, heads, strict=True):
            line.head = head  # what lay in the slots written since was too old to be read again
        self._kp, self._kd, self._gain_age, self._any_new = memory
        self._new[...] = new
        if self._effects is not None:
            self._effects.recall(kept)
        self._update_gains()
        if self._noisy:
            self._noise_used -= 1
        return torque

    def _take_command(self, q_des: Array, kp: Values, kd: Values, dq_des: Values, tau_ff: Values) -> None:
        """Send the command packet off and, while gains change, the gains."""
        self._take_gains(kp, kd)
        packet = self._packets.push()
        np.multiply(self._kp_hat, q_des, out=packet)
        if not _is_zero(dq_des):
            packet += self._kd_hat * dq_des
        if not _is_zero(tau_ff):
            packet += tau_ff
        if self._any_new:
            self._packets.hold(self._new)
        if self._effects is not None:
            self._effects.send(q_des, dq_des, self._new if self._any_new else None)

    def _take_gains(self, kp: Values, kd: Values) -> None:
        """Note the commanded gains; their history is kept until a change has passed the longest delay."""
        if self._kp is None or self._kd is None:
            self._set_gains(kp, kd)
        elif not (_same(kp, self._kp) and _same(kd, self._kd)):
            if self._gain_age >= self._gains.length:  # the history begins with the gains held until now
                self._write_gains(self._gains.push())
                self._gains.hold(...)
            self._gain_age = 0
            self._set_gains(kp, kd)
        if self._gain_age < self._gains.length:
            self._gain_age += 1
            self._write_gains(self._gains.push())
            if self._any_new:
                self._gains.hold(self._new)

    def _set_gains(self, kp: Values, kd: Values) -> None:
        self._kp, self._kd = np.array(kp, dtype=float), np.array(kd, dtype=float)
        self._update_gains()

    def _write_gains(self, slot: Array) -> None:
        joints = self.shape[-1]
        slot[..., :joints] = self._kp
        slot[..., joints:] = self._kd

    def _update_gains(self) -> None:
        if self._kp is not None and self._kd is not None:
            self._kp_hat = self._kp_scale * self._kp
            self._kd_hat = self._kd_scale * self._kd

    def _asked_torque(self, q: Array, dq: Array, out: Array) -> None:
        """Eq. 1 within the brackets, clipped: the law that the actuator computes on the delayed command."""
        kp_hat, kd_hat = self._kp_hat, self._kd_hat
        if self._gain_age < self._gains.length:
            gains = self._gains.read()
            joints = self.shape[-1]
            kp_hat, kd_hat = self._kp_scale * gains[..., :joints], self._kd_scale * gains[..., joints:]
        torque = self._packets.read()
        torque -= np.multiply(kp_hat, q, out=self._scratch)
        torque -= np.multiply(kd_hat, dq, out=self._scratch)
        if self._effects is not None:
            torque = self._effects.apply(torque, q, dq, kp_hat, kd_hat, self._new if self._any_new else None)
        self._clip(torque, out=out)

    def _clip(self, torque: Array, out: Array) -> None:
        np.minimum(torque, self._limit, out=out)
        np.maximum(out, self._floor, out=out)

    def _next_noise(self) -> NDArray[np.float32]:
        """Standard normal numbers for one step, drawn in blocks: calls cost more than one robot's numbers."""
        if self._noise_used == len(self._noise):
            steps = max(1, _NOISE_BLOCK // int(np.prod(self.shape)))
            self._noise = self._rng.standard_normal((steps, *self.shape), dtype=np.float32)
            self._noise_used = 0
        self._noise_used += 1
        noise: NDArray[np.float32] = self._noise[self._noise_used - 1]
        return noise
