"""Effects of a running `ActuatorModel`, step by step, for one robot or a batch.

It keeps only what the effects need: their memories, delayed targets, and a few past states.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from quadvel_actuator.delay import DelayLine
from quadvel_actuator.effects import DRIVE, JOINT, EffectModel, Stage, registry
from quadvel_actuator.effects.basis_regressors import LEARNED_RESIDUAL, BasisRegressor, RunningRegressors
from quadvel_actuator.effects.regressor_entries import load_regressors
from quadvel_actuator.parameters import Effect
from quadvel_description.arrays import Array, Bools

_STATE_HISTORY_S = 0.03
"""Length of the history of positions and velocities, s"""

_DELAYABLE_SIGNALS = "q", "dq"

ACCELERATION_WINDOW_S = 0.002
"""Window of the past over which the acceleration is computed, s"""


class StepView:
    """Signals of one step as effects see them; implements `quadvel_actuator.effects.base.View`."""

    temperature = 25.0
    voltage = np.inf

    def __init__(self, shape: tuple[int, ...], dt: float) -> None:
        """Create a view of a robot at rest.

        Args:
            shape: (..., J), shape of joint arrays.
            dt: s, duration of a step.
        """
        self.dt = self.age = dt
        self.t = np.zeros((*shape[:-1], 1))
        self.q = self.dq = self.ddq = self.q_des = np.zeros(shape)
        self.past: deque[Array] = deque(maxlen=int(_STATE_HISTORY_S / dt) + 2)  # (2, ..., J), q and dq

    @property
    def ddq_smooth(self) -> Array:
        """Acceleration, rad/s^2; a running model cannot smooth over the future, so it is `ddq`."""
        return self.ddq

    ddq_sharp = ddq_smooth

    def shifted(self, name: str, late: Array) -> Array:
        """Interpolate a past position or velocity.

        Args:
            name: `q` or `dq`.
            late: s, age of the value, (J,) or (..., J). The present value stands for negative ages.

        Returns:
            The signal `late` s ago, (..., J).

        Raises:
            ValueError: another name.
        """
        if name not in _DELAYABLE_SIGNALS:
            raise ValueError(f"shifted: found {name}, expected one of {', '.join(_DELAYABLE_SIGNALS)}")
        last = len(self.past) - 1
        back = np.clip(np.broadcast_to(late, self.dq.shape) / self.dt, 0.0, last)
        first = back.astype(np.intp)
        past = np.stack([one[_DELAYABLE_SIGNALS.index(name)] for one in self.past])
        newer, older = (
            np.take_along_axis(past, at[None], 0)[0] for at in (first, np.minimum(first + 1, last))
        )
        found: Array = newer + (back - first) * (older - newer)
        return found


class _RunningEffect:
    """One effect with its parameters (J,) or (..., J) and its memory."""

    def __init__(self, effect: Effect, joints: Sequence[str], rng: np.random.Generator) -> None:
        if effect.name not in registry():
            known = ", ".join(sorted(registry()))
            raise ValueError(f"effects: found {effect.name}, expected one of {known}")
        unknown = [name for name in effect.joints if name not in joints]
        if unknown:
            raise ValueError(
                f"effects/{effect.name}/joints: found {unknown[0]}, expected one of {', '.join(joints)}"
            )
        where = [joints.index(name) for name in effect.joints]
        given = {
            name: _spread_words(value, where, len(joints)) if _is_words(value) else value
            for name, value in effect.parameters.items()
        }
        try:
            form, numbers = registry()[effect.name].parse(given, tuple(joints))
        except ValueError as error:
            raise ValueError(f"effects/{effect.name}/parameters/{error}") from None
        self.model: EffectModel = form.runtime_form(rng)
        self.active = np.array([name in effect.joints for name in joints])
        self.everywhere = bool(self.active.all())
        self.values = {
            parameter.name: _values_per_joint(
                effect, parameter.name, numbers, where, len(joints), parameter.scale
            )
            for parameter in form.parameters
        }
        self.ranges = {
            name: _interval_bounds(effect, name, interval, where, self.values[name])
            for name, interval in effect.intervals.items()
            if name in self.values
        }
        self.memory: tuple[Array, ...] = ()

    def sample(self, ids: Any, rng: np.random.Generator, shape: tuple[int, ...]) -> None:
        """Draw parameters of the environments `ids` uniformly within their intervals.

        They are of `shape` afterwards.

        An interval for all joints gives one number for all, an interval per joint gives one number
        per joint.
        """
        for name, (low, high) in self.ranges.items():
            values = np.broadcast_to(self.values[name], shape).copy()
            drawn = values[ids].shape
            share = rng.random((*drawn[:-1], drawn[-1] if low.ndim else 1))
            values[ids] = np.where(self.active, low + share * (high - low), values[ids])
            self.values[name] = values
        self.values = self.model.canonical(self.values)

    def apply(self, x: Any, now: StepView, new: Bools | None) -> Any:
        """Return the value in place of `x`; environments that are `new` start from rest."""
        after, self.memory = self.model.step(x, now, self.values, self.memory, new)
        if self.everywhere:
            return after
        if self.model.stage == Stage.ADDED:
            return after * self.active
        if isinstance(x, tuple):
            return tuple(np.where(self.active, one, old) for one, old in zip(after, x, strict=True))
        return np.where(self.active, after, x)


def _spread_words(values: Sequence[Any], where: Sequence[int], joints: int) -> list[Any]:
    """Expand one word per joint of the effect to one word per joint of the robot."""
    every = [values[0]] * joints
    for joint, one in zip(where, values, strict=True):
        every[joint] = one
    return every


def _is_words(value: Any) -> bool:
    """Whether a value is a list with words."""
    return isinstance(value, (list, tuple)) and any(isinstance(one, str) for one in value)


def _values_per_joint(
    effect: Effect, name: str, numbers: dict[str, Any], where: Sequence[int], joints: int, idle: float
) -> Array:
    """Expand a parameter to the joints of the robot, (J,); `idle` without the effect."""
    if name not in numbers:
        raise ValueError(f"effects/{effect.name}/parameters: {name} is missing")
    given = np.atleast_1d(np.asarray(numbers[name], dtype=float))
    if given.size not in (1, len(where)):
        raise ValueError(
            f"effects/{effect.name}/parameters/{name}: found {given.size} numbers, expected 1 or {len(where)}"
        )
    column = np.full(joints, idle)
    column[list(where)] = given
    return column


def _interval_bounds(
    effect: Effect, name: str, interval: Any, where: Sequence[int], values: Array
) -> tuple[Array, Array]:
    """Return the lowest and highest value of a parameter, each () or (J,)."""
    given = np.asarray(interval, dtype=float)
    if given.shape not in ((2,), (len(where), 2)) or (given[..., 0] > given[..., 1]).any():
        raise ValueError(
            f"effects/{effect.name}/intervals/{name}: found {interval!r}, expected [low, high], or one for each joint"
        )
    if given.ndim == 1:
        return given[0], given[1]
    low, high = values.copy(), values.copy()
    low[list(where)], high[list(where)] = given.T
    return low, high


def _load_regressors(effect: Effect, joints: Sequence[str]) -> list[BasisRegressor]:
    """Load the basis regressors of an effect of the name `learned_residual`."""
    try:
        return load_regressors(effect.parameters.get("terms"), joints)
    except ValueError as error:
        raise ValueError(f"effects/{effect.name}/parameters/{error}") from None


class RunningEffects:
    """All effects of a running model, in the order of their stages.

    Attributes:
        targets: delay line (..., 2 J) of `q_des` and `dq_des`, for effects that act on the errors.
    """

    def __init__(
        self, effects: Sequence[Effect], joints: Sequence[str], shape: tuple[int, ...], dt: float, seed: int
    ) -> None:
        """Prepare the effects of a parameter file.

        Args:
            effects: entries of the parameter file.
            joints: J joint names of the robot.
            shape: (..., J), shape of joint arrays.
            dt: s, duration of a step.
            seed: seed of effects that act at random.

        Raises:
            ValueError: an entry names an unknown effect, joint or parameter, or has a wrong value.
        """
        rng = np.random.default_rng([seed, 1])
        named = [one for one in effects if one.name != LEARNED_RESIDUAL]
        self._all = sorted(
            (_RunningEffect(one, joints, rng) for one in named), key=lambda one: one.model.stage
        )
        self._errors = [one for one in self._all if one.model.stage == Stage.ERRORS]
        self._torques = [one for one in self._all if Stage.ERRORS < one.model.stage < Stage.ADDED]
        added = [one for one in self._all if one.model.stage == Stage.ADDED]
        self._added = [one for one in added if one.model.at == DRIVE]
        self._at_joint = [one for one in added if one.model.at == JOINT]
        regressors = [
            each for one in effects if one.name == LEARNED_RESIDUAL for each in _load_regressors(one, joints)
        ]
        self._regressors, self._regressors_at_joint = (
            RunningRegressors([one for one in regressors if one.at == at], joints, dt)
            for at in (DRIVE, JOINT)
        )
        self._now = StepView(shape, dt)
        self.targets = DelayLine((*shape[:-1], 2 * shape[-1]), dt)  # q_des, dq_des

    def sample(self, ids: Any, rng: np.random.Generator, shape: tuple[int, ...]) -> None:
        """Draw the parameters of some environments within their intervals.

        Args:
            ids: index of the environments; their memory is invalid afterwards.
            rng: source of randomness.
            shape: (..., J), shape of the parameters afterwards.
        """
        for one in self._all:
            one.sample(ids, rng, shape)

    def push_targets(self, q_des: Any, dq_des: Any, new: Bools | None) -> None:
        """Push the targets of this step into their delay line.

        Args:
            q_des: rad, position targets.
            dq_des: rad/s, velocity targets.
            new: environments without a past, (...,) bool, or None.
        """
        slot = self.targets.push()
        joints = slot.shape[-1] // 2
        slot[..., :joints] = q_des
        slot[..., joints:] = dq_des
        if new is not None:
            self.targets.fill_history(new)

    def drive_torque(
        self, torque: Array, q: Array, dq: Array, kp_hat: Array, kd_hat: Array, new: Bools | None
    ) -> Array:
        """Apply all effects that act in the drive.

        Args:
            torque: N m, torque of the PD law, (..., J).
            q: rad, joint positions.
            dq: rad/s, joint velocities.
            kp_hat: N m/rad, proportional gain in force.
            kd_hat: N m s/rad, derivative gain in force.
            new: environments without a past, (...,) bool, or None.

        Returns:
            N m, torque of the drive, (..., J).
        """
        now = self._update_view(q, dq, new)
        sent = self.targets.read()
        joints = q.shape[-1]
        now.q_des = sent[..., :joints]
        # Stage ERRORS: effects change e = (q_des - q, dq_des - dq) to e', so the PD law gives
        #     tau + kp_hat (e'_q - e_q) + kd_hat (e'_dq - e_dq)
        # Then the stages LIMIT, DYNAMICS and GAIN act in turn. Stage ADDED sums torques that all
        # see
        # the same drive torque.
        if self._errors:
            given = error = (now.q_des - q, sent[..., joints:] - dq)
            for one in self._errors:
                error = one.apply(error, now, new)
            torque = torque + kp_hat * (error[0] - given[0]) + kd_hat * (error[1] - given[1])
        for one in self._torques:
            torque = one.apply(torque, now, new)
        total = torque
        for one in self._added:
            total = total + one.apply(torque, now, new)
        return total + self._regressors.step(total, now, new)

    def joint_torque(self, torque: Array, new: Bools | None) -> Array:
        """Add the effects that act at the joint.

        Args:
            torque: N m, drive torque after the output delay, (..., J).
            new: environments without a past, (...,) bool, or None.

        Returns:
            N m, torque on the joints, (..., J).
        """
        total = torque
        for one in self._at_joint:
            total = total + one.apply(torque, self._now, new)
        return total + self._regressors_at_joint.step(total, self._now, new)

    def _update_view(self, q: Array, dq: Array, new: Bools | None) -> StepView:
        """Take the state of this step into the view and its history."""
        now = self._now
        now.q, now.dq = np.array(q), np.broadcast_to(dq, q.shape).astype(float)
        seen = np.stack([now.q, now.dq])
        now.past.appendleft(seen)
        now.t = now.t + now.dt
        if new is not None:
            now.t = np.where(new[..., None], 0.0, now.t)
            now.past = deque((np.where(new[..., None], seen, old) for old in now.past), now.past.maxlen)
        # ddq = (dq[k] - dq[k - n]) / (n dt), over ACCELERATION_WINDOW_S of the past
        back = min(max(1, round(ACCELERATION_WINDOW_S / now.dt)), len(now.past) - 1)
        now.ddq = (now.dq - now.past[back][1]) / (max(back, 1) * now.dt)
        return now

    @property
    def _memories(self) -> list[_RunningEffect | RunningRegressors]:
        """Everything with a memory."""
        return [*self._all, self._regressors, self._regressors_at_joint]

    def save_memory(self) -> Any:
        """Copy everything that a step changes.

        Returns:
            An opaque value for `restore_memory`.
        """
        now = self._now
        return (
            [one.memory for one in self._memories],
            now.t,
            deque(now.past, now.past.maxlen),
            self.targets.head,
        )

    def restore_memory(self, kept: Any) -> None:
        """Undo the steps since `save_memory`.

        Args:
            kept: what `save_memory` returned.
        """
        memories, self._now.t, self._now.past, self.targets.head = kept
        for one, memory in zip(self._memories, memories, strict=True):
            one.memory = memory
