"""Effects at work in a running `ActuatorModel`, step by step, for one robot or a batch.

Only what the registry's laws need is kept: their memories, the commands under way, and a few past states.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.delay import DelayLine
from quadvel_actuator.effects import DRIVE, JOINT, EffectLaw, MemoryLaw, Stage, registry
from quadvel_actuator.effects.terms import NAME as TERMS
from quadvel_actuator.effects.terms import RunningTerms, Term, all_loaded
from quadvel_actuator.parameters import Effect

Array = NDArray[np.float64]

_PAST = 0.03
"""s of positions and velocities that are kept"""

_KNOWN = "q", "dq"

SLOPE = 0.002
"""s over which the acceleration is taken, all of them past"""


class Instant:
    """What the laws see of one step; see `quadvel_actuator.effects.base.View`."""

    temperature = 25.0
    voltage = np.inf
    packet = row = sent = None

    def __init__(self, shape: tuple[int, ...], dt: float) -> None:
        self.dt = self.age = dt
        self.t = np.zeros((*shape[:-1], 1))
        self.q = self.dq = self.ddq = self.q_des = np.zeros(shape)
        self.past: deque[Array] = deque(maxlen=int(_PAST / dt) + 2)  # (2, ..., J), q and dq

    @property
    def ddq_smooth(self) -> Array:
        """A running model has only the past to take an acceleration from."""
        return self.ddq

    ddq_sharp = ddq_smooth

    def shifted(self, name: str, late: Array) -> Array:
        """q or dq `late` s ago, (J,) or (..., J); one of the future is not known and stays the present one."""
        if name not in _KNOWN:
            raise ValueError(f"shifted: found {name}, expected one of {', '.join(_KNOWN)}")
        last = len(self.past) - 1
        back = np.clip(np.broadcast_to(late, self.dq.shape) / self.dt, 0.0, last)
        first = back.astype(np.intp)
        past = np.stack([one[_KNOWN.index(name)] for one in self.past])
        newer, older = (
            np.take_along_axis(past, at[None], 0)[0] for at in (first, np.minimum(first + 1, last))
        )
        found: Array = newer + (back - first) * (older - newer)
        return found


class _Running:
    """One law with its parameters (J,) and its memory."""

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
            name: _everywhere(value, where, len(joints)) if _is_words(value) else value
            for name, value in effect.parameters.items()
        }
        try:
            form, numbers = registry()[effect.name].read(given, tuple(joints))
        except ValueError as error:
            raise ValueError(f"effects/{effect.name}/parameters/{error}") from None
        self.law: EffectLaw = form.running(rng)
        self.active = np.array([name in effect.joints for name in joints])
        self.everywhere = bool(self.active.all())
        self.values = {
            parameter.name: _column(effect, parameter.name, numbers, where, len(joints), parameter.scale)
            for parameter in form.parameters
        }
        self.ranges = {
            name: _range(effect, name, interval, where, self.values[name])
            for name, interval in effect.intervals.items()
            if name in self.values
        }
        self.memory: tuple[Array, ...] = ()

    def sample(self, ids: Any, rng: np.random.Generator, shape: tuple[int, ...]) -> None:
        """Draw the parameters of the environments `ids` within their intervals, uniform; then they are of `shape`.

        One number for all joints where the interval is one for all, and one for each joint where it is not.
        """
        for name, (low, high) in self.ranges.items():
            values = np.broadcast_to(self.values[name], shape).copy()
            drawn = values[ids].shape
            share = rng.random((*drawn[:-1], drawn[-1] if low.ndim else 1))
            values[ids] = np.where(self.active, low + share * (high - low), values[ids])
            self.values[name] = values
        self.values = self.law.canonical(self.values)

    def act(self, x: Any, now: Instant, new: NDArray[np.bool_] | None) -> Any:
        """The value instead of `x`; environments that are `new` start from rest."""
        law = self.law
        if isinstance(law, MemoryLaw):
            u = [getattr(now, name) for name in law.inputs]
            if new is not None:
                rest = law.rest(x, u, self.values)
                whole = not self.memory or bool(new.all())
                self.memory = (
                    rest
                    if whole
                    else tuple(
                        np.where(new[..., None], fresh, old)
                        for fresh, old in zip(rest, self.memory, strict=True)
                    )
                )
            after, self.memory = law.advance(x, u, now.dt, self.values, self.memory)
        elif law.stage == Stage.ERRORS:
            after = law.errors(x, now, self.values)  # type: ignore[attr-defined]
        else:
            after = law.torque(x, now, self.values)  # type: ignore[attr-defined]
        if self.everywhere:
            return after
        if law.stage == Stage.ADDED:
            return after * self.active
        if isinstance(x, tuple):
            return tuple(np.where(self.active, one, old) for one, old in zip(after, x, strict=True))
        return np.where(self.active, after, x)


def _everywhere(values: Sequence[Any], where: Sequence[int], joints: int) -> list[Any]:
    """A list with a word for each joint of the effect, as one with a word for each joint of the robot."""
    every = [values[0]] * joints
    for joint, one in zip(where, values, strict=True):
        every[joint] = one
    return every


def _is_words(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and any(isinstance(one, str) for one in value)


def _column(
    effect: Effect, name: str, numbers: dict[str, Any], where: Sequence[int], joints: int, idle: float
) -> Array:
    """A parameter as one number for each joint, (J,)."""
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


def _range(
    effect: Effect, name: str, interval: Any, where: Sequence[int], values: Array
) -> tuple[Array, Array]:
    """Lowest and highest value of a parameter: one of each, (), or one for each joint, (J,)."""
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


def _terms(effect: Effect, joints: Sequence[str]) -> list[Term]:
    """The terms that an effect of the name `learned_residual` holds."""
    try:
        return all_loaded(effect.parameters.get("terms"), joints)
    except ValueError as error:
        raise ValueError(f"effects/{effect.name}/parameters/{error}") from None


class RunningEffects:
    """All effects of a model, in the order in which they act."""

    def __init__(
        self, effects: Sequence[Effect], joints: Sequence[str], shape: tuple[int, ...], dt: float, seed: int
    ) -> None:
        rng = np.random.default_rng([seed, 1])
        laws = [one for one in effects if one.name != TERMS]
        self._all = sorted((_Running(one, joints, rng) for one in laws), key=lambda one: one.law.stage)
        self._errors = [one for one in self._all if one.law.stage == Stage.ERRORS]
        self._torques = [one for one in self._all if Stage.ERRORS < one.law.stage < Stage.ADDED]
        added = [one for one in self._all if one.law.stage == Stage.ADDED]
        self._added = [one for one in added if one.law.at == DRIVE]
        self._at_joint = [one for one in added if one.law.at == JOINT]
        terms = [term for one in effects if one.name == TERMS for term in _terms(one, joints)]
        self._terms, self._terms_at_joint = (
            RunningTerms([one for one in terms if one.at == at], joints, dt) for at in (DRIVE, JOINT)
        )
        self._now = Instant(shape, dt)
        self.targets = DelayLine((*shape[:-1], 2 * shape[-1]), dt)  # q_des, dq_des

    def sample(self, ids: Any, rng: np.random.Generator, shape: tuple[int, ...]) -> None:
        """Draw what the intervals leave open for the environments `ids`, whose past is of no use then."""
        for one in self._all:
            one.sample(ids, rng, shape)

    def send(self, q_des: Any, dq_des: Any, new: NDArray[np.bool_] | None) -> None:
        """The targets of this step go their way."""
        slot = self.targets.push()
        joints = slot.shape[-1] // 2
        slot[..., :joints] = q_des
        slot[..., joints:] = dq_des
        if new is not None:
            self.targets.hold(new)

    def apply(
        self, torque: Array, q: Array, dq: Array, kp_hat: Array, kd_hat: Array, new: NDArray[np.bool_] | None
    ) -> Array:
        """What the drive gives where the PD law asks for `torque`."""
        now = self._observe(q, dq, new)
        sent = self.targets.read()
        joints = q.shape[-1]
        now.q_des = sent[..., :joints]
        if self._errors:
            given = error = (now.q_des - q, sent[..., joints:] - dq)
            for one in self._errors:
                error = one.act(error, now, new)
            torque = torque + kp_hat * (error[0] - given[0]) + kd_hat * (error[1] - given[1])
        for one in self._torques:
            torque = one.act(torque, now, new)
        total = torque
        for one in self._added:
            total = total + one.act(torque, now, new)
        return total + self._terms.act(total, now, new)

    def at_joint(self, torque: Array, new: NDArray[np.bool_] | None) -> Array:
        """What the joints get, now, of the drives' `torque`, which comes an output delay after it was asked for."""
        total = torque
        for one in self._at_joint:
            total = total + one.act(torque, self._now, new)
        return total + self._terms_at_joint.act(total, self._now, new)

    def _observe(self, q: Array, dq: Array, new: NDArray[np.bool_] | None) -> Instant:
        now = self._now
        now.q, now.dq = np.array(q), np.broadcast_to(dq, q.shape).astype(float)
        seen = np.stack([now.q, now.dq])
        now.past.appendleft(seen)
        now.t = now.t + now.dt
        if new is not None:
            now.t = np.where(new[..., None], 0.0, now.t)
            now.past = deque((np.where(new[..., None], seen, old) for old in now.past), now.past.maxlen)
        back = min(max(1, round(SLOPE / now.dt)), len(now.past) - 1)
        now.ddq = (now.dq - now.past[back][1]) / (max(back, 1) * now.dt)
        return now

    @property
    def _memories(self) -> list[_Running | RunningTerms]:
        return [*self._all, self._terms, self._terms_at_joint]

    def remember(self) -> Any:
        """Everything that a step changes, for `recall`."""
        now = self._now
        return (
            [one.memory for one in self._memories],
            now.t,
            deque(now.past, now.past.maxlen),
            self.targets.head,
        )

    def recall(self, kept: Any) -> None:
        """Take steps since `remember` back."""
        memories, self._now.t, self._now.past, self.targets.head = kept
        for one, memory in zip(self._memories, memories, strict=True):
            one.memory = memory
