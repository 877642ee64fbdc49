"""The EAM with effects on it, over whole logs: what it predicts, and how it is fitted.

All parameters are fitted together by damped least squares. A parameter is shared by the joints of a group; every joint
keeps its own small Jacobian, and sharing is an index into the common unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.effects import DRIVE, AddedLaw, EffectLaw, ErrorLaw, MemoryLaw, Stage
from quadvel_actuator.effects.base import distinct

from .signals import BETWEEN, Array, Bools, Samples, Signals

Groups = NDArray[np.intp]

_DAMPING = (1e-7, 1e-2, 1.0)
_SLOPE = 0.01  # step of the numerical slopes, in a parameter's usual size
_GAIN_SLOPE = 0.01
_FAR = 0.4
"""Logarithm of a gain over the commanded one that is hard to believe."""
_SETTLED = 1e-5  # relative fall of the error below which a fit has converged


@attrs.frozen(eq=False)
class Applied:
    """A law at work on some joints."""

    law: EffectLaw
    active: Bools  # (J,)
    values: Array  # (P, J)
    groups: Groups  # (J,), joints with the same number share the values
    held: bool = False
    """is all but what is linear left as it is while others are fitted?"""

    def part(self, values: Array) -> dict[str, Array]:
        """Parameters by name; `values` (B, P, J) becomes (B, 1, J) each, or (J,) where the batch has one value."""
        found = {}
        for k, name in enumerate(self.law.names):
            one = values[:, k]
            found[name] = one[0] if len(one) == 1 or (one == one[0]).all() else one[:, None]
        return found

    def formed(self, law: EffectLaw) -> Applied:
        """With another form of its law; parameters that this one had not start from zero."""
        known = dict(zip(self.law.names, self.values, strict=True))
        none = np.zeros_like(self.values[0])
        return attrs.evolve(self, law=law, values=np.array([known.get(name, none) for name in law.names]))

    def tidied(self) -> Applied:
        """With the form of its law that its joints need, and parameters in their unique order."""
        mine = self.formed(self.law.among(self.active))
        p = mine.law.tidy(dict(zip(mine.law.names, mine.values, strict=True)))
        return attrs.evolve(mine, values=np.array([p[name] for name in mine.law.names]))


@attrs.frozen(eq=False)
class Model:
    """EAM parameters of each joint, (J,) or (2, J), and the effects on it."""

    samples: Samples
    window: float
    gains: Array
    gain_groups: Groups  # (2, J)
    input_delay: Array
    output_delay: Array
    delay_groups: Groups  # (J,)
    applied: tuple[Applied, ...] = ()
    gains_held: bool = False
    """do the gains stay as they are while everything else is fitted?"""
    implied: bool = False
    """is the torque that it is fitted to not measured, but what the motion implies?"""

    @property
    def signals(self) -> Signals:
        """The signals at this model's delays."""
        return self.samples.at(self.input_delay, self.output_delay, self.window)

    def seen(self, at: str) -> Signals:
        """The signals for torques that are added by the drive, or at the joint: these do not come an output delay late."""
        if at == DRIVE:
            return self.signals
        return self.samples.at_joint(self.input_delay, self.output_delay, self.window)

    @property
    def believable(self) -> bool:
        """Are its proportional gains near those that were commanded?"""
        return bool((np.abs(np.log(np.maximum(self.gains[0], 1e-3))) <= _FAR).all())

    def as_commanded(self) -> Model:
        """With its gains held as they were commanded."""
        return attrs.evolve(self, gains=np.ones_like(self.gains), gains_held=True)

    def predict(self) -> Array:
        """Torque of every row, (N, J), N m."""
        torque: Array = self.evaluate(self.gains[None], [one.values[None] for one in self.applied])[0]
        return torque

    def residual(self, rows: Bools) -> Array:
        """Measured minus predicted torque, (N, J), 0 outside `rows`."""
        left: Array = np.where(rows, self.samples.tau - self.predict(), 0.0)
        return left

    def error(self, rows: Bools) -> float:
        """Sum of squared errors over `rows` (N, J)."""
        left = self.residual(rows)
        return float(np.sum(left * left))

    def mse(self, rows: Bools) -> float:
        """Mean squared error over `rows` (N, J)."""
        return self.error(rows) / max(int(rows.sum()), 1)

    def evaluate(self, gains: Array, values: Sequence[Array]) -> Array:
        """Torque (B, N, J) for a batch of gains (B, 2, J) and of each effect's values (B, P, J).

        A drive that computes in steps does nothing between them; one that does not is followed between the rows.
        """
        if self.window == 0.0 and any(one.law.between for one in self.applied):
            finer = attrs.evolve(self, samples=self.samples.finer)
            return finer._evaluate(gains, values)[..., BETWEEN - 1 :: BETWEEN, :]
        return self._evaluate(gains, values)

    def _evaluate(self, gains: Array, values: Sequence[Array]) -> Array:
        """The same at the instants of `samples` alone."""
        s = self.signals
        todo = sorted(zip(self.applied, values, strict=True), key=lambda pair: pair[0].law.stage)
        pull, drag = self._asked(s, [pair for pair in todo if pair[0].law.stage == Stage.ERRORS])
        g = _lean(gains)
        x = g[..., 0, :][..., None, :] * pull + g[..., 1, :][..., None, :] * drag + s.tau_ff
        for one, value in todo:
            if Stage.ERRORS < one.law.stage < Stage.ADDED:
                x = _where(one.active, self._series(one, x, s, value), x)
        total = x
        for one, value in todo:
            if one.law.stage == Stage.ADDED:
                total = total + self.added(one, x, value)
        batch = max(len(gains), *(len(value) for value in values)) if values else len(gains)
        return np.broadcast_to(total, (batch, *s.q.shape))

    def added(self, one: Applied, x: Array, value: Array) -> Array:
        """The torque (B, N, J) that a law of the stage ADDED adds to `x`, with a batch of its values (B, P, J)."""
        extra: Array = self._series(one, x, self.seen(one.law.at), value)
        return extra if one.active.all() else extra * one.active

    def driven(self) -> Array:
        """Torque (N, J) of the drive, without what is added to it."""
        drive = tuple(one for one in self.applied if one.law.stage < Stage.ADDED)
        return attrs.evolve(self, applied=drive).predict()

    def _asked(self, s: Signals, todo: Sequence[tuple[Applied, Array]]) -> tuple[Array, Array]:
        """What the gains are factors of, after the laws `todo` that act on the errors."""
        if not todo:
            return s.pull, s.drag
        error: tuple[Array, Array] = (s.q_des - s.q, s.dq_des - s.dq)
        for one, value in todo:
            error = self._errors(one, error, s, value)
        return s.kp * error[0], s.kd * error[1]

    def _errors(
        self, one: Applied, error: tuple[Array, Array], s: Signals, value: Array
    ) -> tuple[Array, Array]:
        """The errors after a law."""
        after = self._series(one, error, s, value)
        new, speed = (_where(one.active, new, old) for new, old in zip(after, error, strict=True))
        return new, speed

    def _series(self, one: Applied, x: Any, s: Signals, value: Array) -> Any:
        """What a law makes of `x`."""
        law, p = one.law, one.part(value)
        if isinstance(law, ErrorLaw):
            if max(part.ndim for part in x) > 2:
                return law.errors(x, s, p)
            first, which = distinct(value)
            after = law.errors(x, s, one.part(value[first]))
            return tuple(part[which] if part.ndim > 2 else part for part in after)
        if isinstance(law, MemoryLaw):
            return law.series(x, s, p)
        return law.torque(x, s, p)  # type: ignore[attr-defined]

    def reaching(self, rows: Bools) -> tuple[Model, Bools]:
        """The model and `rows` (N, J) of it without the logs at the end that hold none of them."""
        samples = self.samples.reaching(rows)
        return attrs.evolve(self, samples=samples), rows[: len(samples.t)]

    def with_delays(self, input_delay: Array, output_delay: Array) -> Model:
        """The same model with other delays (J,)."""
        return attrs.evolve(self, input_delay=input_delay, output_delay=output_delay)

    def plus(self, applied: Applied) -> Model:
        """With one more effect."""
        return attrs.evolve(self, applied=(*self.applied, applied))

    def replacing(self, index: int, applied: Applied) -> Model:
        """With another effect in the place of this index."""
        return attrs.evolve(self, applied=(*self.applied[:index], applied, *self.applied[index + 1 :]))

    def foretold(self) -> Model:
        """With laws that say no more than could be known before the torque was measured."""
        applied = (attrs.evolve(one, law=one.law.foretold()) for one in self.applied)
        return attrs.evolve(self, applied=tuple(applied))

    def holding(self, held: bool) -> Model:
        """With the memories of its laws held as they are, which makes fits of others cheap, or with all of it free."""
        applied = (attrs.evolve(one, held=held and one.law.remembers) for one in self.applied)
        return attrs.evolve(self, applied=tuple(applied))

    def without(self, index: int) -> Model:
        """Without the effect of this index."""
        return attrs.evolve(self, applied=(*self.applied[:index], *self.applied[index + 1 :]))


def _lean(batch: Array) -> Array:
    """A batch of equal values as one."""
    return batch[:1] if len(batch) > 1 and (batch == batch[0]).all() else batch


def _where(active: Bools, new: Array, old: Array) -> Array:
    return new if active.all() else np.where(active, new, old)


@attrs.frozen(eq=False)
class Slots:
    """The unknowns of a fit: slot a of joint j (gains first, then each effect's parameters) is unknown index[a, j]."""

    index: Groups  # (A, J), -1: not fitted
    low: Array  # (A, J)
    high: Array
    step: Array  # (A,)
    count: int

    @classmethod
    def of(cls, model: Model) -> Slots:
        """All parameters of the model."""
        joints = model.gains.shape[1]
        rows, low, high, step = [], [], [], []
        count = 0

        def add(groups: Groups, active: Bools, bounds: tuple[float, float], size: float) -> None:
            nonlocal count
            names = np.unique(groups[active])
            found = np.where(active, count + np.searchsorted(names, groups), -1)
            rows.append(found)
            low.append(np.full(joints, bounds[0]))
            high.append(np.full(joints, bounds[1]))
            step.append(size)
            count += len(names)

        everywhere = np.ones(joints, dtype=bool)
        for groups in model.gain_groups:
            add(groups, everywhere & (not model.gains_held), (-1e6, 1e6), _GAIN_SLOPE)
        for one in model.applied:
            linear = getattr(one.law, "linear", ())
            for parameter in one.law.parameters:
                free = one.active & (not one.held or parameter.name in linear)
                add(one.groups, free, (parameter.low, parameter.high), _SLOPE * parameter.scale)
        return cls(np.array(rows), np.array(low), np.array(high), np.array(step), count)


def unpack(model: Model, theta: Array) -> tuple[Array, list[Array]]:
    """Slots (B, A, J) as gains (B, 2, J) and values (B, P, J) of each effect."""
    values, first = [], 2
    for one in model.applied:
        last = first + len(one.law.parameters)
        values.append(theta[:, first:last])
        first = last
    return theta[:, :2], values


def pack(model: Model) -> Array:
    """All slots (A, J) of a model."""
    return np.concatenate([model.gains, *(one.values for one in model.applied)])


def with_slots(model: Model, theta: Array) -> Model:
    """The model with the slots (A, J)."""
    gains, values = unpack(model, theta[None])
    applied = tuple(
        attrs.evolve(one, values=value[0]) for one, value in zip(model.applied, values, strict=True)
    )
    return attrs.evolve(model, gains=gains[0], applied=applied)


def jacobian(model: Model, slots: Slots) -> tuple[Array, Array]:
    """Prediction (N, J) and its slopes (J, A, N) along every slot."""
    theta = pack(model)
    steps = np.where(theta + slots.step[:, None] > slots.high, -slots.step[:, None], slots.step[:, None])
    free: Bools = np.any(slots.index >= 0, axis=1)
    alone = np.zeros(len(theta), dtype=bool)
    slopes = np.zeros((theta.shape[1], len(theta), len(model.samples.t)))
    first = 2
    for one in model.applied:
        mine = first + np.arange(len(one.values))
        first += len(mine)
        if isinstance(one.law, AddedLaw) and not one.law.of_drive:
            alone[mine] = True
            some = mine[free[mine]]
            values = _stepped(theta[mine], steps[mine], some - mine[0])
            slopes[:, some] = _slopes(model.added(one, model.signals.q, values), steps[some])
    rest = np.flatnonzero(free & ~alone)
    torque = model.evaluate(*unpack(model, _stepped(theta, steps, rest)))
    slopes[:, rest] = _slopes(torque, steps[rest])
    return torque[0], slopes


def _stepped(values: Array, steps: Array, which: Groups) -> Array:
    """A batch of `values` (A, J): as they are, and with a step along each of the rows `which`."""
    batch = np.repeat(values[None], len(which) + 1, axis=0)
    batch[1 + np.arange(len(which)), which] += steps[which]
    return batch


def _slopes(torque: Array, steps: Array) -> Array:
    """Slopes (J, A, N) of torques (1 + A, N, J), the first one without a step of `steps` (A, J)."""
    slopes: Array = ((torque[1:] - torque[0]) / steps[:, None, :]).transpose(2, 0, 1)
    return slopes


def gather(slots: Slots, local: Array) -> Array:
    """Per-joint matrices (J, A, A) or vectors (J, A) summed into the common unknowns."""
    fitted = slots.index.T >= 0
    at = np.where(fitted, slots.index.T, 0)
    if local.ndim == 2:
        total = np.zeros(slots.count)
        np.add.at(total, at, np.where(fitted, local, 0.0))
        return total
    square = np.zeros((slots.count, slots.count))
    both = fitted[:, :, None] & fitted[:, None, :]
    np.add.at(square, (at[:, :, None], at[:, None, :]), np.where(both, local, 0.0))
    return square


def fit(model: Model, rows: Bools, iterations: int = 5) -> Model:
    """The model with gains and effects fitted to `rows` (N, J); the delays stay."""
    whole, model, rows = model.samples, *model.reaching(rows)
    slots = Slots.of(model)
    for _ in range(iterations if slots.count else 0):
        predicted, slopes = jacobian(model, slots)
        left = np.where(rows, model.samples.tau - predicted, 0.0)
        error = float(np.sum(left * left))
        slopes *= rows.T[:, None]
        hessian = gather(slots, slopes @ slopes.transpose(0, 2, 1))
        gradient = gather(slots, np.einsum("jan,nj->ja", slopes, left))
        theta = pack(model)
        trials = np.stack([step(slots, theta, hessian, gradient, damping) for damping in _DAMPING])
        errors = _errors(model, trials, rows)
        best = int(np.argmin(errors))
        if not errors[best] < error:
            break
        model = with_slots(model, trials[best])
        if errors[best] > error * (1.0 - _SETTLED):
            break
    return attrs.evolve(model, samples=whole, applied=tuple(one.tidied() for one in model.applied))


def _errors(model: Model, theta: Array, rows: Bools) -> Array:
    """Sum of squares of each of a batch of slots (B, A, J)."""
    left = (model.evaluate(*unpack(model, theta)) - model.samples.tau) * rows
    return np.einsum("bnj,bnj->b", left, left)


def step(slots: Slots, theta: Array, hessian: Array, gradient: Array, damping: float) -> Array:
    """Slots (A, J) after one damped step; what would leave its bounds stays on them."""
    held = np.zeros(slots.count, dtype=bool)
    after = theta
    for _ in range(2):
        free = ~held
        size = np.diagonal(hessian)[free]
        matrix = hessian[np.ix_(free, free)] + np.diag(damping * size + 1e-12 * (1.0 + size.max(initial=0.0)))
        change = np.zeros(slots.count)
        change[free] = np.linalg.solve(matrix, gradient[free])
        move = np.where(slots.index >= 0, change[slots.index], 0.0)
        after = np.clip(theta + move, slots.low, slots.high)
        stuck = (slots.index >= 0) & (after == theta) & (move != 0.0)
        if not stuck.any():
            break
        held[slots.index[stuck]] = True
    return after
