"""Forward model of the joint torque: the EAM with effects, and its Jacobian.

The equations, in the order in which a drive computes them:

    tau_asked = g_p kp (q_des - q) + g_d kd (dq_des - dq) + tau_ff    (laws of the errors first)
    tau_drive = tau_asked after the bounds, lags and gains of the effects
    tau       = tau_drive + added torques + weighted regressors of named signals

`g_p` and `g_d` are the ratios of real to commanded gains. Commands act one input delay late, and
the torque of the drive appears one output delay later. Joints with the same group number share a
parameter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_actuator.effects import DRIVE, AddedLaw, EffectLaw, ErrorLaw, MemoryLaw, Stage
from quadvel_actuator.effects.base import distinct_indices
from quadvel_description.arrays import Array, Bools, Indices

from ..data.signals import Samples, Signals

MAX_DELAYS_S = np.array([0.020, 0.006])
"""Upper bounds of the input delay and of the output delay, s."""


@attrs.frozen(eq=False)
class AppliedEffect:
    """An effect law with its parameter values on the joints that it acts on.

    A weighted sum of regressors of named signals (`library.SignalTerm`) is a law whose torque is
    linear in its weights.

    Attributes:
        law: Equations of the effect.
        active: Joints that the effect acts on, (J,) bool.
        values: Parameter values in the order of `law.parameters`, (P, J), in the units of the law.
        groups: Group numbers, (J,). Joints with the same number share their values.
    """

    law: EffectLaw
    active: Bools
    values: Array
    groups: Indices

    @property
    def reads_total_torque(self) -> bool:
        """Whether the law reads the torque of all other laws, and is evaluated after them."""
        return bool(getattr(self.law, "reads_total", False))

    def parameters_by_name(self, values: Array) -> dict[str, Array]:
        """Return a batch of parameter values as a dict by parameter name.

        Args:
            values: Parameter values, (B, P, J).

        Returns:
            For each parameter an array (B, 1, J), or (J,) where all entries of the batch are equal.
        """
        found = {}
        for k, name in enumerate(self.law.names):
            column = values[:, k]
            found[name] = column[0] if len(column) == 1 or (column == column[0]).all() else column[:, None]
        return found

    def is_excited(self, s: Signals) -> bool:
        """Whether the motion excites the law on at least one joint of every group.

        Args:
            s: Signals of the log at the delays of the model.

        Returns:
            True if every group of active joints holds an excited joint.
        """
        excited = (
            self.law.excited_joints(dict(zip(self.law.names, self.values, strict=True)), s) & self.active
        )
        return set(self.groups[excited]) == set(self.groups[self.active])

    def with_law(self, law: EffectLaw) -> AppliedEffect:
        """Return the effect with another form of its law.

        Args:
            law: The new form. Parameters that the present law lacks start from zero.

        Returns:
            The effect with values (P', J) in the order of the new law.
        """
        known = dict(zip(self.law.names, self.values, strict=True))
        none = np.zeros_like(self.values[0])
        return attrs.evolve(self, law=law, values=np.array([known.get(name, none) for name in law.names]))

    def canonical(self) -> AppliedEffect:
        """Return the effect in canonical form: the simplest law, with parameters in unique order.

        Returns:
            An equivalent effect. Two fits of one truth have the same canonical form.
        """
        restricted = self.with_law(self.law.restricted_to(self.active))
        p = restricted.law.canonical(dict(zip(restricted.law.names, restricted.values, strict=True)))
        return attrs.evolve(restricted, values=np.array([p[name] for name in restricted.law.names]))


@attrs.frozen(eq=False)
class Model:
    """Actuator model of all joints: gains, delays and effects, on the samples of the logs.

    Attributes:
        samples: Rows of all logs.
        window: Step of a drive that averages commands over it, s; 0 for a drive without such a
            step.
        gains: Ratios of real to commanded kp and kd, (2, J). Where no gain is commanded, the gains
            themselves in N m/rad and N m s/rad.
        gain_groups: Group numbers of the joints, (J,); joints with the same number share their
            gains.
        delays: Input and output delay, (2, J), s.
        delay_groups: Group numbers of the joints, (J,), for the delays.
        effects: Effects, in the order in which they were added.
    """

    samples: Samples
    window: float
    gains: Array
    gain_groups: Indices
    delays: Array
    delay_groups: Indices
    effects: tuple[AppliedEffect, ...] = ()

    @property
    def signals(self) -> Signals:
        """Signals of all rows at the delays of this model, (N, J) each."""
        return self.samples.at(self.delays[0], self.delays[1], self.window)

    def signals_at(self, at: str) -> Signals:
        """Return the signals that an added torque depends on.

        Torques at the joint act without the output delay, torques of the drive with it.

        Args:
            at: `DRIVE` or `JOINT`.

        Returns:
            Signals at the delays of the model for that place.
        """
        if at == DRIVE:
            return self.signals
        return self.samples.at_joint(self.delays[0], self.delays[1], self.window)

    def predict(self) -> Array:
        """Predict the torque of every row.

        Returns:
            Torque, (N, J), N m.
        """
        torque: Array = self.evaluate(self.gains[None], [effect.values[None] for effect in self.effects])[0]
        return torque

    def residual(self) -> Array:
        """Return the measured minus the predicted torque.

        Returns:
            Residual, (N, J), N m.
        """
        residual: Array = self.samples.tau - self.predict()
        return residual

    def evaluate(self, gains: Array, values: Sequence[Array]) -> Array:
        """Predict the torque for a batch of parameter values.

        A drive with a step computes at the rows alone. Without a step, laws that act between rows
        are evaluated on upsampled signals.

        Args:
            gains: Gain ratios, (B, 2, J).
            values: For each effect its parameter values, (B, P, J).

        Returns:
            Torque, (B, N, J), N m.
        """
        if self.window == 0.0 and any(effect.law.acts_between_rows for effect in self.effects):
            upsampled, each = (
                attrs.evolve(self, samples=self.samples.upsampled),
                self.samples.instants_per_row,
            )
            return upsampled._evaluate(gains, values)[..., each - 1 :: each, :]
        return self._evaluate(gains, values)

    def _evaluate(self, gains: Array, values: Sequence[Array]) -> Array:
        """Evaluate the torque at the rows of `samples`, without upsampling."""
        # tau = x + sum_i f_i(x) + sum_k g_k(x + sum_i f_i(x)), with the drive torque x, the added
        # laws f_i, and the added laws g_k that read the total torque.
        x = self._drive_torque(gains, values)
        added = [pair for pair in zip(self.effects, values, strict=True) if _is_added(pair[0])]
        total = x
        for effect, value in added:
            if not effect.reads_total_torque:
                total = total + self.added_torque(effect, x, value)
        total_of_laws = total
        for effect, value in added:
            if effect.reads_total_torque:
                total = total + self.added_torque(effect, total_of_laws, value)
        batch = max(len(gains), *(len(value) for value in values)) if values else len(gains)
        return np.broadcast_to(total, (batch, *self.signals.q.shape))

    def _drive_torque(self, gains: Array, values: Sequence[Array]) -> Array:
        """Torque of the drive (B, N, J), without the added torques."""
        s = self.signals
        stiffness_torque, damping_torque = s.stiffness_torque, s.damping_torque
        in_order = sorted(zip(self.effects, values, strict=True), key=lambda pair: pair[0].law.stage)
        on_errors = [pair for pair in in_order if pair[0].law.stage == Stage.ERRORS]
        if on_errors:
            error: tuple[Array, Array] = (s.q_des - s.q, s.dq_des - s.dq)
            for effect, value in on_errors:
                error = self._apply_to_errors(effect, error, s, value)
            stiffness_torque, damping_torque = s.kp * error[0], s.kd * error[1]
        g = gains[:1] if len(gains) > 1 and (gains == gains[0]).all() else gains
        x: Array = (
            g[..., 0, :][..., None, :] * stiffness_torque
            + g[..., 1, :][..., None, :] * damping_torque
            + s.tau_ff
        )
        for effect, value in in_order:
            if Stage.ERRORS < effect.law.stage < Stage.ADDED:
                x = _select_active(effect.active, _apply_law(effect, x, s, value), x)
        return x

    def _apply_to_errors(
        self, effect: AppliedEffect, error: tuple[Array, Array], s: Signals, value: Array
    ) -> tuple[Array, Array]:
        """Apply a law of the stage ERRORS to the errors of position and speed."""
        after = _apply_law(effect, error, s, value)
        new, speed = (_select_active(effect.active, new, old) for new, old in zip(after, error, strict=True))
        return new, speed

    def drive_torque(self, effect: AppliedEffect) -> Array:
        """Return the torque that an added law receives as its input.

        Args:
            effect: An added effect, part of this model or not.

        Returns:
            Torque of the drive, (N, J), N m; with all other added torques if the law reads the
            total.
        """
        kept = tuple(
            other
            for other in self.effects
            if not _is_added(other) or (effect.reads_total_torque and not other.reads_total_torque)
        )
        return attrs.evolve(self, effects=kept).predict()

    def added_torque(self, effect: AppliedEffect, x: Array, value: Array) -> Array:
        """Return the torque that an effect of the stage ADDED adds.

        Args:
            effect: The effect.
            x: Input of the law, (N, J) or (B, N, J), N m; see `drive_torque`.
            value: Batch of parameter values, (B, P, J).

        Returns:
            Added torque, (B, N, J), N m; 0 on joints that the effect does not act on.
        """
        extra: Array = _apply_law(effect, x, self.signals_at(effect.law.at), value)
        return extra if effect.active.all() else extra * effect.active

    def with_delays(self, delays: Array) -> Model:
        """Return the model with other delays.

        Args:
            delays: Input and output delay, (2, J), s; clipped to [0, `MAX_DELAYS_S`], rounded to
                0.1 us.

        Returns:
            A new model.
        """
        clipped = np.asarray(np.clip(delays, 0.0, MAX_DELAYS_S[:, None]), dtype=float).round(7)
        return attrs.evolve(self, delays=clipped)

    def with_effect(self, applied: AppliedEffect) -> Model:
        """Return the model with one more effect.

        Args:
            applied: The effect to append.

        Returns:
            A new model.
        """
        return attrs.evolve(self, effects=(*self.effects, applied))

    def with_replaced_effect(self, index: int, applied: AppliedEffect) -> Model:
        """Return the model with one effect replaced.

        Args:
            index: Index of the effect to replace.
            applied: The new effect.

        Returns:
            A new model.
        """
        return attrs.evolve(self, effects=(*self.effects[:index], applied, *self.effects[index + 1 :]))

    def without_effect(self, index: int) -> Model:
        """Return the model without one of its effects.

        Args:
            index: Index of the effect to remove.

        Returns:
            A new model.
        """
        return attrs.evolve(self, effects=(*self.effects[:index], *self.effects[index + 1 :]))

    def predictive(self) -> Model:
        """Return the model with the predictive form of every law.

        A law may infer random events, such as lost commands, from the measured torque. Its
        predictive form uses only what is known before the torque is measured.

        Returns:
            A new model.
        """
        return attrs.evolve(
            self, effects=tuple(attrs.evolve(effect, law=effect.law.predictive()) for effect in self.effects)
        )


def _is_added(effect: AppliedEffect) -> bool:
    """Whether the effect adds its torque to that of the drive."""
    return effect.law.stage == Stage.ADDED


def _select_active(active: Bools, new: Array, old: Array) -> Array:
    """Values after a law on the active joints, values before it on the others."""
    return new if active.all() else np.where(active, new, old)


def _apply_law(effect: AppliedEffect, x: Any, s: Signals, value: Array) -> Any:
    """Apply a law of any kind to its input `x` over whole series."""
    law, p = effect.law, effect.parameters_by_name(value)
    if isinstance(law, ErrorLaw):
        if max(part.ndim for part in x) > 2:
            return law.errors(x, s, p)
        first, which = distinct_indices(value)
        after = law.errors(x, s, effect.parameters_by_name(value[first]))
        return tuple(part[which] if part.ndim > 2 else part for part in after)
    if isinstance(law, MemoryLaw):
        return law.series(x, s, p)
    return law.torque(x, s, p)  # type: ignore[attr-defined]


def linear_columns(model: Model, effect: AppliedEffect, x: Array | None = None) -> Array:
    """Return the torque per unit of each linear parameter of an added law.

    The nonlinear parameters keep their values, so that the torque is the weighted sum of these
    columns.

    Args:
        model: Model whose delays and drive torque the law sees.
        effect: The added effect.
        x: Input of the law, (N, J), N m; `model.drive_torque(one)` if None.

    Returns:
        Regressors, (L, N, J).
    """
    x, s = model.drive_torque(effect) if x is None else x, model.signals_at(effect.law.at)
    columns = getattr(effect.law, "regressors", None)
    if columns is not None:
        found: Array = columns(x, s)
        return found if effect.active.all() else found * effect.active
    linear = [effect.law.names.index(name) for name in effect.law.linear]  # type: ignore[attr-defined]
    unit = np.repeat(effect.values[None], len(linear), axis=0)
    unit[:, linear] = 0.0
    unit[np.arange(len(linear)), linear] = 1.0
    return np.broadcast_to(model.added_torque(effect, x, unit), (len(linear), *x.shape))


@attrs.frozen(eq=False)
class Unknowns:
    """Mapping from the parameter slots of a model to the vector of unknowns of a fit.

    A slot is one gain, one effect parameter or one delay, on every joint.

    Attributes:
        index: Unknown of slot a on joint j, (A, J); -1 where the slot is not fitted.
        low: Lower bounds of the unknowns, (K,).
        high: Upper bounds of the unknowns, (K,).
        step: Step of the finite differences of each slot, (A,).
    """

    index: Indices
    low: Array
    high: Array
    step: Array

    @property
    def count(self) -> int:
        """Number of unknowns K."""
        return len(self.low)

    @classmethod
    def of(cls, model: Model, delays: bool = True) -> Unknowns:
        """Collect the unknowns of a model.

        Args:
            model: The model to fit.
            delays: Whether the delays are fitted.

        Returns:
            The mapping, with one unknown for each slot and group of joints.
        """
        rows: list[Indices] = []
        low: list[float] = []
        high: list[float] = []
        step: list[float] = []
        for groups, free, bounds, size in _parameter_slots(model, delays):
            names = np.unique(groups[free])
            rows.append(np.where(free, len(low) + np.searchsorted(names, groups), -1))
            low += [bounds[0]] * len(names)
            high += [bounds[1]] * len(names)
            step.append(size)
        return cls(np.array(rows), np.array(low, dtype=float), np.array(high, dtype=float), np.array(step))

    def accumulate(self, local: Array) -> Array:
        """Sum vectors or matrices of the joints into the shared unknowns.

        Args:
            local: Vectors (J, A) or matrices (J, A, A) over the slots of each joint.

        Returns:
            Vector (K,) or matrix (K, K) over the unknowns.
        """
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
        """Return the vector of unknowns of given slot values.

        Args:
            theta: Slot values, (A, J).

        Returns:
            Unknowns, (K,).
        """
        found = np.zeros(self.count)
        used = self.index >= 0
        found[self.index[used]] = theta[used]
        return found


_MAX_GAIN_RATIO = 4.0
"""Upper bound of the ratio of real to commanded gain."""
RELATIVE_STEP = 0.01
"""Finite-difference step, as a fraction of the parameter's scale."""
DELAY_STEP_S = 0.0003
"""Half the span of central differences along a delay, s; not small, as commands are steps."""


def _parameter_slots(
    model: Model, delays: bool
) -> Iterator[tuple[Indices, Bools, tuple[float, float], float]]:
    """Indices, free joints, bounds and finite-difference step of each slot."""
    everywhere = np.ones(model.gains.shape[1], dtype=bool)
    has_gains = model.samples.commanded and not model.samples.undamped
    for _ in model.gains:
        yield model.gain_groups, everywhere, (0.0, _MAX_GAIN_RATIO if has_gains else 1e6), RELATIVE_STEP
    for effect in model.effects:
        for parameter in effect.law.parameters:
            yield (
                effect.groups,
                effect.active,
                (parameter.low, parameter.high),
                RELATIVE_STEP * parameter.scale,
            )
    for longest in MAX_DELAYS_S:
        yield model.delay_groups, everywhere & delays, (0.0, float(longest)), DELAY_STEP_S


def pack(model: Model) -> Array:
    """Stack all parameters of a model into slots.

    Args:
        model: The model.

    Returns:
        Slot values, (A, J): gains, values of each effect, delays.
    """
    return np.concatenate([model.gains, *(effect.values for effect in model.effects), model.delays])


def with_slots(model: Model, theta: Array) -> Model:
    """Return the model with other slot values; the inverse of `pack`.

    Args:
        model: The model.
        theta: Slot values, (A, J).

    Returns:
        A new model.
    """
    gains, values = _unpack(model, theta[None])
    applied = tuple(
        attrs.evolve(effect, values=value[0]) for effect, value in zip(model.effects, values, strict=True)
    )
    return attrs.evolve(model, gains=gains[0], effects=applied).with_delays(theta[-2:])


def _unpack(model: Model, theta: Array) -> tuple[Array, list[Array]]:
    """Split slots (B, A, J) into gains and the values of each effect."""
    values, first = [], 2
    for effect in model.effects:
        values.append(theta[:, first : first + len(effect.values)])
        first += len(effect.values)
    return theta[:, :2], values


def jacobian(model: Model, unknowns: Unknowns) -> tuple[Array, Array]:
    """Predict the torque and differentiate it with respect to every slot.

    Linear parameters of added laws have exact derivatives, their regressors. Delays use central
    differences, all others forward differences (backward ones at an upper bound). The derivative of
    regressors that read the total torque neglects how that torque changes with the other slots.

    Args:
        model: The model.
        unknowns: Which slots are fitted.

    Returns:
        Prediction (N, J), N m, and derivatives (J, A, N); 0 for slots that are not fitted.
    """
    theta, free = pack(model), np.any(unknowns.index >= 0, axis=1)
    high = np.where(unknowns.index >= 0, unknowns.high[unknowns.index], np.inf)
    steps = np.where(theta + unknowns.step[:, None] > high, -unknowns.step[:, None], unknowns.step[:, None])
    slopes = np.zeros((theta.shape[1], len(theta), len(model.samples.t)))

    # Exact derivatives: tau = ... + sum_l w_l phi_l has d tau / d w_l = phi_l.
    numeric, first, term_torque = free.copy(), 2, np.zeros(model.samples.tau.shape)
    numeric[-2:] = False
    for effect in model.effects:
        slots = first + np.arange(len(effect.values))
        first += len(slots)
        if _is_added(effect):
            columns = linear_columns(model, effect)
            linear = slots[[effect.law.names.index(name) for name in effect.law.linear]]  # type: ignore[attr-defined]
            slopes[:, linear] = columns.transpose(2, 0, 1)
            numeric[linear] = False
            if effect.reads_total_torque:
                numeric[slots] = False
                term_torque = term_torque + np.einsum("kj,knj->nj", theta[slots], columns)

    # Finite differences: row 0 of the batch is theta, the others theta + h_a e_a.
    numeric_slots = np.flatnonzero(numeric)
    batch = np.repeat(theta[None], len(numeric_slots) + 1, axis=0)
    batch[1 + np.arange(len(numeric_slots)), numeric_slots] += steps[numeric_slots]
    kept_effects = tuple(effect for effect in model.effects if not effect.reads_total_torque)
    without_terms = attrs.evolve(model, effects=kept_effects)
    gains, values = _unpack(model, batch[:, :-2])
    law_values = [
        value for effect, value in zip(model.effects, values, strict=True) if not effect.reads_total_torque
    ]
    torque = without_terms.evaluate(gains, law_values)
    differences = (torque[1:] - torque[0]) / steps[numeric_slots][:, None, :]
    slopes[:, numeric_slots] = differences.transpose(2, 0, 1)
    for k in np.flatnonzero(free[-2:]):
        slopes[:, len(theta) - 2 + k] = _delay_slope(model, int(k)).T
    return torque[0] + term_torque, slopes


def _delay_slope(model: Model, which: int) -> Array:
    """Derivative (N, J) of the torque along the input delay (0) or the output delay (1)."""
    dependent = tuple(effect for effect in model.effects if _depends_on_delay(effect.law, which))
    moved = attrs.evolve(model, effects=dependent)
    step = np.zeros((2, 1))
    step[which] = DELAY_STEP_S
    high, low = moved.with_delays(model.delays + step), moved.with_delays(model.delays - step)
    slope: Array = (high.predict() - low.predict()) / (high.delays - low.delays)[which]
    return slope


def _depends_on_delay(law: EffectLaw, which: int) -> bool:
    """Whether the torque of a law changes with the input delay (0) or the output delay (1).

    The commands select which acceleration is read, so that a law of `ddq` depends on both.
    """
    if not isinstance(law, AddedLaw) or law.depends_on_drive_torque or law.signal == "ddq":
        return True
    return which == 1 and law.at == DRIVE
