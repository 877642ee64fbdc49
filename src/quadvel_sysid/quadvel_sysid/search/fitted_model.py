"""Fitted models and their selection criterion, which the search compares.

`model.fit` fits a model, `statistics.criterion` defines the criterion, and `selection` searches.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import attrs
import numpy as np

from quadvel_description.arrays import Array, Indices

from ..data.split import DataSplit
from ..model.applied_effect import AppliedEffect
from ..model.fit import MAX_ITERATIONS, expected_errors, fit, fit_delay_profile, fit_delay_splits
from ..model.torque_model import Model
from ..options import SEARCH_DEFAULTS, SearchOptions
from ..parallel import parallel_map
from ..statistics.criterion import (
    PENALTY_PER_PARAMETER,
    SIGNIFICANCE_LEVEL,
    WHITENESS_LEVEL,
    Comparison,
    compare_residuals,
    normality_p_values,
    whiteness_p_values,
)

TRIAL_ITERATIONS = 4
"""Steps of a fit that show which of several models or starts is worth a whole fit."""
RIVAL_FRACTION = 0.5
"""Fraction of the best candidate's gain above which another candidate is its rival."""
_VARIANCE_FLOOR = 1e-12
"""Added to variances, N^2 m^2, for logs without noise."""


@attrs.frozen(eq=False)
class FittedModel:
    """A fitted model with its errors and criterion on the selection rows.

    Attributes:
        model: The fitted model.
        evaluator: Data that it was fitted to and is compared on.
    """

    model: Model
    evaluator: ModelEvaluator

    @cached_property
    def residual(self) -> Array:
        """Measured minus predicted torque, (N, J), N m."""
        return self.model.residual()

    @cached_property
    def selection_mse(self) -> Array:
        """Mean squared error of each joint on the selection rows, (J,), N^2 m^2, as in `squared_error`.

        It includes the encoder noise that the effects average out.
        """
        rows = self.evaluator.parts.select
        square = np.sum(self.residual**2 + self.model.averaged_noise(), axis=0, where=rows)
        mse: Array = square / np.maximum(rows.sum(axis=0), 1) + self.model.noise_averaged_by_effects(rows)
        return mse

    @cached_property
    def criterion(self) -> float:
        """Information criterion: sum over joints of ln(mse / noise) plus the parameter penalty.

        The logarithm is twice the negative log-likelihood of a row for normal noise of unknown
        variance. Lower is better.
        """
        return float(self.log_errors.sum()) + PENALTY_PER_PARAMETER * parameter_count(
            self.model, self.evaluator.options.memory_cost
        )

    @property
    def log_errors(self) -> Array:
        """Logarithm of each joint's error on the selection rows, relative to the noise, (J,)."""
        found: Array = np.log(self.relative_errors)
        return found

    @property
    def relative_errors(self) -> Array:
        """Each joint's error on the selection rows, relative to the noise, (J,)."""
        noise = self.evaluator.noise + _VARIANCE_FLOOR
        found: Array = (self.selection_mse + _VARIANCE_FLOOR) / noise
        return found

    def compare_with(self, before: FittedModel) -> Comparison:
        """Compare with another fitted model on the selection rows.

        Args:
            before: The model without the change in question.

        Returns:
            Score test of the change from `before` to this model.
        """
        return compare_residuals(
            self.evaluator.parts, before.residual, self.residual, self.evaluator.parts.select
        )

    @cached_property
    def is_white(self) -> bool:
        """Whether the residual on the fitted and selection rows passes as white noise."""
        parts, samples = self.evaluator.parts, self.model.samples
        p = whiteness_p_values(self.residual, parts.fit_or_select, samples.start, parts.noise_overlap)
        if self.evaluator.options.kurtosis_test:
            p = np.minimum(p, normality_p_values(self.residual, parts.fit_or_select))
        return bool((p * 2 * len(p) > WHITENESS_LEVEL).all())

    @property
    def last_effect(self) -> AppliedEffect:
        """The effect that was added last."""
        return self.model.effects[-1]


def parameter_count(model: Model, memory_cost: float) -> float:
    """Count the parameters of a model beyond those of the plain EAM.

    Args:
        model: The model.
        memory_cost: Further parameters that an effect with memory, or one like a delay, counts as.

    Returns:
        Number of parameters; values shared by joints count once, see `EffectCandidate.complexity`.
    """
    total = 2.0 * (len(np.unique(model.gain_groups)) + len(np.unique(model.delay_groups)) - 2)
    for effect in model.effects:
        total += effect.candidate.complexity(memory_cost) * len(np.unique(effect.groups[effect.active]))
    return total


@attrs.frozen(eq=False)
class ModelEvaluator:
    """Fits models to the fitted rows and compares them on the selection rows.

    Attributes:
        parts: Data split.
        noise: Variance of the torque noise, (J,), N^2 m^2.
        reading_error: Error of the torque that unknown instants of the drive leave, (J,), N^2 m^2.
        cores: Worker processes.
        options: Options of the search.
    """

    parts: DataSplit
    noise: Array
    reading_error: Array
    cores: int = 1
    options: SearchOptions = SEARCH_DEFAULTS

    def fit(self, model: Model, iterations: int = MAX_ITERATIONS) -> FittedModel:
        """Fit a model to the fitted rows.

        Args:
            model: Start of the fit.
            iterations: Maximum number of steps.

        Returns:
            The fitted model.
        """
        return FittedModel(fit(model, self.parts.fit, iterations), self)

    def fit_each(self, models: Sequence[Model], iterations: int = MAX_ITERATIONS) -> list[FittedModel]:
        """Fit several models of the same samples in parallel.

        Args:
            models: Starts of the fits.
            iterations: Maximum number of steps of a fit.

        Returns:
            The fitted models, in the same order.
        """
        if not models:
            return []
        found = parallel_map(
            lambda k: fit(models[k], self.parts.fit, iterations), len(models), self.cores, models[0].samples
        )
        return [FittedModel(one, self) for one in found]

    def finer_groupings(self, fitted: FittedModel, limit: float) -> list[FittedModel]:
        """Fit models with gains, or delays, for each kind of joint and for each joint.

        Args:
            fitted: A fitted model.
            limit: Criterion that a model has to reach.

        Returns:
            The models that reach it.
        """
        model, finer = fitted.model, list[Model]()
        for groups in joint_groupings(model.samples.joints) if self.options.gains_of_each_joint else ():
            count = len(np.unique(groups))
            if count > len(np.unique(model.gain_groups)):
                finer.append(attrs.evolve(model, gain_groups=groups))
            if count > len(np.unique(model.delay_groups)):
                finer.append(attrs.evolve(model, delay_groups=groups))
        # Most finer groupings gain less than their parameters cost, which one linearisation or few
        # steps show.
        errors = expected_errors([model, *finer], self.parts.fit)
        change = [
            float(np.log(error + _VARIANCE_FLOOR).sum() - np.log(errors[0] + _VARIANCE_FLOOR).sum())
            + PENALTY_PER_PARAMETER * (self._parameter_count(one) - self._parameter_count(model))
            for one, error in zip(finer, errors[1:], strict=True)
        ]
        expected = [one for one, each in zip(finer, change, strict=True) if fitted.criterion + each < limit]
        begun = self.fit_each(expected, iterations=TRIAL_ITERATIONS)
        return self.fit_each([one.model for one in begun if one.criterion < limit])

    def _parameter_count(self, model: Model) -> float:
        return parameter_count(model, self.options.memory_cost)

    def refine_delays(self, fitted: FittedModel) -> FittedModel:
        """Search the delays again on a grid, as biased delays may have hidden the optimum.

        Args:
            fitted: A fitted model.

        Returns:
            `fitted` or the refitted model, whichever has the lower criterion.
        """
        return min(
            fitted,
            FittedModel(fit_delay_profile(fitted.model, self.parts.fit, self.cores, self.options), self),
            key=lambda one: one.criterion,
        )

    def refine_split(self, fitted: FittedModel) -> FittedModel:
        """Fit a model again from other splits of its total delay into input and output delay.

        Args:
            fitted: A fitted model.

        Returns:
            `fitted` or the refitted model, whichever has the lower criterion.
        """
        other = FittedModel(fit_delay_splits(fitted.model, self.parts.fit), self)
        return min(fitted, other, key=lambda one: one.criterion)

    def restrict_joints(self, fitted: FittedModel, index: int) -> FittedModel:
        """Restrict an effect to the joints where it is significant, if that lowers the criterion.

        Args:
            fitted: A fitted model.
            index: Index of the effect.

        Returns:
            `fitted` or the model with the effect on fewer joints.
        """
        effect = fitted.model.effects[index]
        if effect.candidate.all_joints_together:
            return fitted
        without = FittedModel(fitted.model.without_effect(index), self)  # other values as fitted
        comparison = fitted.compare_with(without)
        cost = PENALTY_PER_PARAMETER * effect.candidate.complexity(self.options.memory_cost)
        needed = (
            effect.active
            & (comparison.joint_p_values < SIGNIFICANCE_LEVEL)
            & (comparison.relative_gain > cost)
        )
        if not needed.any() or (needed == effect.active).all():
            return fitted
        if needed.sum() == 1 and not effect.candidate.possible_on_one_joint:
            return fitted
        fewer = self.fit(fitted.model.with_replaced_effect(index, attrs.evolve(effect, active=needed)))
        return min(fitted, fewer, key=lambda one: one.criterion)

    def share_across_joints(self, fitted: FittedModel, index: int) -> FittedModel:
        """Share the values of an effect between joints, if that lowers the criterion.

        All joints are tried first, then joints of one kind (hip, thigh, calf).

        Args:
            fitted: A fitted model.
            index: Index of the effect.

        Returns:
            `fitted` or the model with shared values.
        """
        effect = fitted.model.effects[index]
        all_joints = np.zeros(len(effect.active), dtype=np.intp)
        for groups in (all_joints, *joint_groupings(fitted.model.samples.joints)):
            if len(np.unique(groups[effect.active])) >= len(np.unique(effect.groups[effect.active])):
                continue
            values = effect.values.copy()
            for g in np.unique(groups[effect.active]):
                alike = effect.active & (groups == g)
                values[:, alike] = values[:, alike].mean(axis=1, keepdims=True)
            shared = attrs.evolve(effect, groups=groups, values=values)
            shared_fit = self.fit(fitted.model.with_replaced_effect(index, shared))
            if shared_fit.criterion < fitted.criterion:
                return shared_fit
        return fitted


def joint_kinds(joints: Iterable[str]) -> Indices:
    """Number the kinds of joints, whose names differ in the first part only.

    `FR_hip_joint` and `FL_hip_joint` are of one kind.

    Args:
        joints: Names of the joints.

    Returns:
        Kind of each joint, (J,).
    """
    names = [name.partition("_")[2] or name for name in joints]
    found: Indices = np.unique(names, return_inverse=True)[1]
    return found


def joint_groupings(joints: Sequence[str]) -> list[Indices]:
    """List the ways to group joints: by kind, and each joint alone.

    Args:
        joints: Names of the joints.

    Returns:
        Group numbers, (J,) each; the grouping by kind only where several joints are of one kind.
    """
    own = np.arange(len(joints))
    by_kind = joint_kinds(joints)
    return [by_kind, own] if by_kind.max() + 1 < len(joints) else [own]
