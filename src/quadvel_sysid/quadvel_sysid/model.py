"""What the actuator model with effects on it predicts for the rows of a log, and how that changes with its parameters.

    asked torque = g_p kp (q_des - q) + g_d kd (dq_des - dq) + tau_ff      after the laws of the errors
    drive torque = the asked torque after bounds, lags and gains
    torque       = drive torque + added torques + terms of named signals

`g_p`, `g_d` are real over commanded gains. Commands come an input delay late, and the whole an output delay later. A
parameter may be shared by joints: `groups` number what is the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.effects import DRIVE, AddedLaw, EffectLaw, ErrorLaw, MemoryLaw, Stage
from quadvel_actuator.effects.base import distinct_indices

from .signals import INSTANTS_PER_ROW, Array, Bools, Samples, Signals

Groups = NDArray[np.intp]

MAX_DELAYS_S = np.array([0.020, 0.006])
"""s, input and output delay at most"""


@attrs.frozen(eq=False)
class AppliedEffect:
    """A law at work on some joints. A term of named signals is a law whose torque is linear in its weights."""

    law: EffectLaw
    active: Bools  # (J,)
    values: Array  # (P, J)
    groups: Groups  # (J,), joints with the same number share the values

    @property
    def reads_total_torque(self) -> bool:
        """Does it read the torque of all other laws, so that it comes after them?"""
        return bool(getattr(self.law, "reads_total", False))

    def parameters_by_name(self, values: Array) -> dict[str, Array]:
        """Parameters by name; `values` (B, P, J) becomes (B, 1, J) each, or (J,) where the batch has one value."""
        found = {}
        for k, name in enumerate(self.law.names):
            one = values[:, k]
            found[name] = one[0] if len(one) == 1 or (one == one[0]).all() else one[:, None]
        return found

    def is_excited(self, s: Signals) -> bool:
        """Does the motion of one at least of the joints that share values show the law?"""
        joints = self.law.excited_joints(dict(zip(self.law.names, self.values, strict=True)), s) & self.active
        return set(self.groups[joints]) == set(self.groups[self.active])

    def with_form(self, law: EffectLaw) -> AppliedEffect:
        """With another form of its law; parameters that this one had not start from zero."""
        known = dict(zip(self.law.names, self.values, strict=True))
        none = np.zeros_like(self.values[0])
        return attrs.evolve(self, law=law, values=np.array([known.get(name, none) for name in law.names]))

    def canonical(self) -> AppliedEffect:
        """With the form of its law that its joints need, and parameters in their unique order."""
        mine = self.with_form(self.law.restricted_to(self.active))
        p = mine.law.canonical(dict(zip(mine.law.names, mine.values, strict=True)))
        return attrs.evolve(mine, values=np.array([p[name] for name in mine.law.names]))


@attrs.frozen(eq=False)
class Model:
    """Gains and delays of each joint, (2, J), and the effects on it."""

    samples: Samples
    window: float
    """s, the step of a drive that gives means over it; 0 for none"""
    gains: Array
    gain_groups: Groups  # (J,)
    delays: Array
    """(2, J) s, input and output"""
    delay_groups: Groups  # (J,)
    effects: tuple[AppliedEffect, ...] = ()

    @property
    def signals(self) -> Signals:
        """The signals at this model's delays."""
        return self.samples.at(self.delays[0], self.delays[1], self.window)

    def signals_at(self, at: str) -> Signals:
        """The signals for torques that are added by the drive, or at the joint: these do not come an output delay late."""
        if at == DRIVE:
            return self.signals
        return self.samples.at_joint(self.delays[0], self.delays[1], self.window)

    def predict(self) -> Array:
        """Torque of every row, (N, J), N m."""
        torque: Array = self.evaluate(self.gains[None], [one.values[None] for one in self.effects])[0]
        return torque

    def residual(self) -> Array:
        """Measured minus predicted torque, (N, J)."""
        left: Array = self.samples.tau - self.predict()
        return left

    def evaluate(self, gains: Array, values: Sequence[Array]) -> Array:
        """Torque (B, N, J) for a batch of gains (B, 2, J) and of each effect's values (B, P, J).

        A drive that computes in steps does nothing between them; one that does not is followed between the rows.
        """
        if self.window == 0.0 and any(one.law.acts_between_rows for one in self.effects):
            finer = attrs.evolve(self, samples=self.samples.upsampled)
            return finer._evaluate(gains, values)[..., INSTANTS_PER_ROW - 1 :: INSTANTS_PER_ROW, :]
        return self._evaluate(gains, values)

    def _evaluate(self, gains: Array, values: Sequence[Array]) -> Array:
        """The same at the instants of `samples` alone."""
        x = self._drive(gains, values)
        total, added = x, [pair for pair in zip(self.effects, values, strict=True) if _is_added(pair[0])]
        for one, value in added:
            if not one.reads_total_torque:
                total = total + self.added_torque(one, x, value)
        whole = total
        for one, value in added:
            if one.reads_total_torque:
                total = total + self.added_torque(one, whole, value)
        batch = max(len(gains), *(len(value) for value in values)) if values else len(gains)
        return np.broadcast_to(total, (batch, *self.signals.q.shape))

    def _drive(self, gains: Array, values: Sequence[Array]) -> Array:
        """Torque of the drive, without what is added to it."""
        s = self.signals
        pull, drag = s.stiffness_torque, s.damping_torque
        todo = sorted(zip(self.effects, values, strict=True), key=lambda pair: pair[0].law.stage)
        on_errors = [pair for pair in todo if pair[0].law.stage == Stage.ERRORS]
        if on_errors:
            error: tuple[Array, Array] = (s.q_des - s.q, s.dq_des - s.dq)
            for one, value in on_errors:
                error = self._errors(one, error, s, value)
            pull, drag = s.kp * error[0], s.kd * error[1]
        g = gains[:1] if len(gains) > 1 and (gains == gains[0]).all() else gains
        x: Array = g[..., 0, :][..., None, :] * pull + g[..., 1, :][..., None, :] * drag + s.tau_ff
        for one, value in todo:
            if Stage.ERRORS < one.law.stage < Stage.ADDED:
                x = _where(one.active, _series(one, x, s, value), x)
        return x

    def _errors(
        self, one: AppliedEffect, error: tuple[Array, Array], s: Signals, value: Array
    ) -> tuple[Array, Array]:
        """The errors after a law."""
        after = _series(one, error, s, value)
        new, speed = (_where(one.active, new, old) for new, old in zip(after, error, strict=True))
        return new, speed

    def drive_torque(self, beside: AppliedEffect) -> Array:
        """What a law that is added is given, (N, J): the torque of the drive, of all laws where it reads that."""
        kept = tuple(
            one
            for one in self.effects
            if not _is_added(one) or (beside.reads_total_torque and not one.reads_total_torque)
        )
        return attrs.evolve(self, effects=kept).predict()

    def added_torque(self, one: AppliedEffect, x: Array, value: Array) -> Array:
        """The torque (B, N, J) that a law of the stage ADDED adds to `x`, with a batch of its values (B, P, J)."""
        extra: Array = _series(one, x, self.signals_at(one.law.at), value)
        return extra if one.active.all() else extra * one.active

    def with_delays(self, delays: Array) -> Model:
        """The same model with other delays (2, J)."""
        within = np.asarray(np.clip(delays, 0.0, MAX_DELAYS_S[:, None]), dtype=float).round(7)
        return attrs.evolve(self, delays=within)

    def with_effect(self, applied: AppliedEffect) -> Model:
        """With one more effect."""
        return attrs.evolve(self, effects=(*self.effects, applied))

    def with_replaced_effect(self, index: int, applied: AppliedEffect) -> Model:
        """With another effect in the place of this index."""
        return attrs.evolve(self, effects=(*self.effects[:index], applied, *self.effects[index + 1 :]))

    def without_effect(self, index: int) -> Model:
        """Without the effect of this index."""
        return attrs.evolve(self, effects=(*self.effects[:index], *self.effects[index + 1 :]))

    def predictive(self) -> Model:
        """With laws that say no more than could be known before the torque was measured."""
        return attrs.evolve(
            self, effects=tuple(attrs.evolve(one, law=one.law.predictive()) for one in self.effects)
        )


def _is_added(one: AppliedEffect) -> bool:
    return one.law.stage == Stage.ADDED


def _where(active: Bools, new: Array, old: Array) -> Array:
    return new if active.all() else np.where(active, new, old)


def _series(one: AppliedEffect, x: Any, s: Signals, value: Array) -> Any:
    """What a law makes of `x`."""
    law, p = one.law, one.parameters_by_name(value)
    if isinstance(law, ErrorLaw):
        if max(part.ndim for part in x) > 2:
            return law.errors(x, s, p)
        first, which = distinct_indices(value)
        after = law.errors(x, s, one.parameters_by_name(value[first]))
        return tuple(part[which] if part.ndim > 2 else part for part in after)
    if isinstance(law, MemoryLaw):
        return law.series(x, s, p)
    return law.torque(x, s, p)  # type: ignore[attr-defined]


def linear_columns(model: Model, one: AppliedEffect, x: Array | None = None) -> Array:
    """What a unit of each linear parameter of an added law gives, (L, N, J), the others being as they are.

    `x` (N, J) is what the law is given, `model.driven(one)`, where that is known.
    """
    x, s = model.drive_torque(one) if x is None else x, model.signals_at(one.law.at)
    columns = getattr(one.law, "regressors", None)
    if columns is not None:
        found: Array = columns(x, s)
        return found if one.active.all() else found * one.active
    linear = [one.law.names.index(name) for name in one.law.linear]  # type: ignore[attr-defined]
    unit = np.repeat(one.values[None], len(linear), axis=0)
    unit[:, linear] = 0.0
    unit[np.arange(len(linear)), linear] = 1.0
    return np.broadcast_to(model.added_torque(one, x, unit), (len(linear), *x.shape))


@attrs.frozen(eq=False)
class Unknowns:
    """The unknowns of a fit: slot a of joint j is unknown index[a, j]; slots are gains, effects' values, delays."""

    index: Groups  # (A, J), -1: not fitted
    low: Array  # (count,)
    high: Array
    step: Array  # (A,), for numerical slopes

    @property
    def count(self) -> int:
        return len(self.low)

    @classmethod
    def of(cls, model: Model, delays: bool = True) -> Unknowns:
        """All parameters of the model; its delays only if asked for."""
        rows: list[Groups] = []
        low: list[float] = []
        high: list[float] = []
        step: list[float] = []
        for groups, free, bounds, size in _slots(model, delays):
            names = np.unique(groups[free])
            rows.append(np.where(free, len(low) + np.searchsorted(names, groups), -1))
            low += [bounds[0]] * len(names)
            high += [bounds[1]] * len(names)
            step.append(size)
        return cls(np.array(rows), np.array(low, dtype=float), np.array(high, dtype=float), np.array(step))

    def accumulate(self, local: Array) -> Array:
        """Per-joint vectors (J, A) or matrices (J, A, A) summed into the common unknowns."""
        fitted = self.index.T >= 0
        at = np.where(fitted, self.index.T, 0)
        if local.ndim == 2:
            total = np.zeros(self.count)
            np.add.at(total, at, np.where(fitted, local, 0.0))
            return total
        square = np.zeros((self.count, self.count))
        both = fitted[:, :, None] & fitted[:, None, :]
        np.add.at(square, (at[:, :, None], at[:, None, :]), np.where(both, local, 0.0))
        return square

    def vector(self, theta: Array) -> Array:
        """Slots (A, J) as unknowns."""
        found = np.zeros(self.count)
        used = self.index >= 0
        found[self.index[used]] = theta[used]
        return found


_MAX_GAIN_RATIO = 4.0
"""Times the commanded gain: what a drive gives of it at most"""
RELATIVE_STEP = 0.01
"""Step of numerical slopes, of a parameter's usual size"""
DELAY_STEP_S = 0.0003
"""s, between the predictions that a slope along a delay is taken from, to either side: commands come in steps"""


def _slots(model: Model, delays: bool) -> Iterator[tuple[Groups, Bools, tuple[float, float], float]]:
    """Of each slot: who shares it, where it is free, bounds, and the step of its slope."""
    everywhere = np.ones(model.gains.shape[1], dtype=bool)
    known = model.samples.commanded and not model.samples.undamped
    for _ in model.gains:
        yield model.gain_groups, everywhere, (0.0, _MAX_GAIN_RATIO if known else 1e6), RELATIVE_STEP
    for one in model.effects:
        for parameter in one.law.parameters:
            yield one.groups, one.active, (parameter.low, parameter.high), RELATIVE_STEP * parameter.scale
    for longest in MAX_DELAYS_S:
        yield model.delay_groups, everywhere & delays, (0.0, float(longest)), DELAY_STEP_S


def pack(model: Model) -> Array:
    """All slots (A, J) of a model."""
    return np.concatenate([model.gains, *(one.values for one in model.effects), model.delays])


def with_slots(model: Model, theta: Array) -> Model:
    """The model with the slots (A, J)."""
    gains, values = _unpack(model, theta[None])
    applied = tuple(
        attrs.evolve(one, values=value[0]) for one, value in zip(model.effects, values, strict=True)
    )
    return attrs.evolve(model, gains=gains[0], effects=applied).with_delays(theta[-2:])


def _unpack(model: Model, theta: Array) -> tuple[Array, list[Array]]:
    values, first = [], 2
    for one in model.effects:
        values.append(theta[:, first : first + len(one.values)])
        first += len(one.values)
    return theta[:, :2], values


def jacobian(model: Model, unknowns: Unknowns) -> tuple[Array, Array]:
    """Prediction (N, J) and its slopes (J, A, N) along every slot; 0 where a slot is not fitted.

    Terms that read the torque of the laws are taken not to move with these: they are small beside them.
    """
    theta, free = pack(model), np.any(unknowns.index >= 0, axis=1)
    high = np.where(unknowns.index >= 0, unknowns.high[unknowns.index], np.inf)
    steps = np.where(theta + unknowns.step[:, None] > high, -unknowns.step[:, None], unknowns.step[:, None])
    slopes = np.zeros((theta.shape[1], len(theta), len(model.samples.t)))
    numeric, first, read = free.copy(), 2, np.zeros(model.samples.tau.shape)
    numeric[-2:] = False
    for one in model.effects:
        mine = first + np.arange(len(one.values))
        first += len(mine)
        if _is_added(one):
            columns = linear_columns(model, one)
            linear = mine[[one.law.names.index(name) for name in one.law.linear]]  # type: ignore[attr-defined]
            slopes[:, linear] = columns.transpose(2, 0, 1)
            numeric[linear] = False
            if one.reads_total_torque:
                numeric[mine] = False
                read = read + np.einsum("kj,knj->nj", theta[mine], columns)
    rest = np.flatnonzero(numeric)
    batch = np.repeat(theta[None], len(rest) + 1, axis=0)
    batch[1 + np.arange(len(rest)), rest] += steps[rest]
    laws = attrs.evolve(model, effects=tuple(one for one in model.effects if not one.reads_total_torque))
    gains, values = _unpack(model, batch[:, :-2])
    kept = [value for one, value in zip(model.effects, values, strict=True) if not one.reads_total_torque]
    torque = laws.evaluate(gains, kept)
    slopes[:, rest] = ((torque[1:] - torque[0]) / steps[rest][:, None, :]).transpose(2, 0, 1)
    for k in np.flatnonzero(free[-2:]):
        slopes[:, len(theta) - 2 + k] = _delay_slope(model, int(k)).T
    return torque[0] + read, slopes


def _delay_slope(model: Model, which: int) -> Array:
    """Slope (N, J) of the torque along the input delay (0) or the output delay (1)."""
    felt = tuple(one for one in model.effects if _depends_on_delay(one.law, which))
    moved = attrs.evolve(model, effects=felt)
    step = np.zeros((2, 1))
    step[which] = DELAY_STEP_S
    high, low = moved.with_delays(model.delays + step), moved.with_delays(model.delays - step)
    slope: Array = (high.predict() - low.predict()) / (high.delays - low.delays)[which]
    return slope


def _depends_on_delay(law: EffectLaw, which: int) -> bool:
    """Does its torque change with the input delay (0), or the output delay (1)? An acceleration is read as commands move it."""
    if not isinstance(law, AddedLaw) or law.depends_on_drive_torque or law.signal == "ddq":
        return True
    return which == 1 and law.at == DRIVE
