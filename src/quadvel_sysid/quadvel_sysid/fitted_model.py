"""A fitted model and what it is worth on the rows that select: what the search compares."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import attrs
import numpy as np

from .criterion import (
    PENALTY_PER_PARAMETER,
    SIGNIFICANCE_LEVEL,
    WHITENESS_LEVEL,
    Comparison,
    DataSplit,
    normality,
    whiteness,
)
from .fit import fit, fit_delay_profile
from .library import complexity
from .model import AppliedEffect, Groups, Model
from .parallel import side_by_side
from .signals import Array

_TINY = 1e-12  # N^2 m^2, of a log without noise


@attrs.frozen(eq=False)
class FittedModel:
    """A fitted model, and what it is worth on the rows that select."""

    model: Model
    evaluator: ModelEvaluator

    @cached_property
    def residual(self) -> Array:
        """Measured less predicted torque, (N, J)."""
        return self.model.residual()

    @cached_property
    def selection_mse(self) -> Array:
        """Mean squared error of the rows that select, N^2 m^2, (J,)."""
        rows = self.evaluator.parts.select
        square = np.sum(np.where(rows, self.residual, 0.0) ** 2, axis=0)
        left: Array = square / np.maximum(rows.sum(axis=0), 1)
        return left

    @cached_property
    def criterion(self) -> float:
        """Twice the negative log likelihood of a row's torque, of normal noise of unknown variance, and what parameters cost."""
        return float(
            np.log((self.selection_mse + _TINY) / (self.evaluator.noise + _TINY)).sum()
        ) + PENALTY_PER_PARAMETER * parameter_count(self.model)

    def compare_with(self, before: FittedModel) -> Comparison:
        """On the rows that select."""
        return self.evaluator.parts.compare(before.residual, self.residual, self.evaluator.parts.select)

    @cached_property
    def is_white(self) -> bool:
        """Is nothing left but noise, on the rows that fit and select?"""
        parts, samples = self.evaluator.parts, self.model.samples
        p = whiteness(self.residual, parts.fit_or_select, samples.start, parts.overlap)
        p = np.minimum(p, normality(self.residual, parts.fit_or_select))
        return bool((p * 2 * len(p) > WHITENESS_LEVEL).all())

    @property
    def last_effect(self) -> AppliedEffect:
        return self.model.effects[-1]


def parameter_count(model: Model) -> float:
    """How many parameters a model has, each joint's own counted, those of the plain model not."""
    total = 2.0 * (len(np.unique(model.gain_groups)) + len(np.unique(model.delay_groups)) - 2)
    for one in model.effects:
        total += complexity(one.law) * len(np.unique(one.groups[one.active]))
    return total


@attrs.frozen(eq=False)
class ModelEvaluator:
    """The data that models are fitted to and held against."""

    parts: DataSplit
    noise: Array
    """variance of the torque's noise (J,), N^2 m^2"""
    cores: int = 1
    """that work side by side"""

    def fit(self, model: Model) -> FittedModel:
        """The model fitted to the rows for that."""
        return FittedModel(fit(model, self.parts.fit), self)

    def fit_each(self, models: Sequence[Model]) -> list[FittedModel]:
        """Several models of the same samples, each fitted."""
        if not models:
            return []
        found = side_by_side(
            lambda k: fit(models[k], self.parts.fit), len(models), self.cores, models[0].samples
        )
        return [FittedModel(one, self) for one in found]

    def refine_delays(self, account: FittedModel) -> FittedModel:
        """With its delays sought on a grid once more: what was added may have hidden the right ones."""
        return min(
            account,
            FittedModel(fit_delay_profile(account.model, self.parts.fit, self.cores), self),
            key=lambda one: one.criterion,
        )

    def restrict_joints(self, every: FittedModel, index: int) -> FittedModel:
        """The account with an effect on the joints alone that need it, where that is better."""
        one = every.model.effects[index]
        if one.law.all_joints_together:
            return every
        idle = FittedModel(every.model.without_effect(index), self)
        found = every.compare_with(idle)
        cost = PENALTY_PER_PARAMETER * complexity(one.law)
        needed = one.active & (found.p_joints < SIGNIFICANCE_LEVEL) & (found.share > cost)
        if not needed.any() or (needed == one.active).all():
            return every
        fewer = self.fit(every.model.with_replaced_effect(index, attrs.evolve(one, active=needed)))
        return min(every, fewer, key=lambda one: one.criterion)

    def share_across_joints(self, account: FittedModel, index: int) -> FittedModel:
        """With the values of an effect shared by its joints, or by those of a kind, where that costs nothing."""
        one = account.model.effects[index]
        every = np.zeros(len(one.active), dtype=np.intp)
        for groups in (every, *joint_groupings(account.model.samples.joints)):
            if len(np.unique(groups[one.active])) >= len(np.unique(one.groups[one.active])):
                continue
            values = one.values.copy()
            for g in np.unique(groups[one.active]):
                alike = one.active & (groups == g)
                values[:, alike] = values[:, alike].mean(axis=1, keepdims=True)
            shared = attrs.evolve(one, groups=groups, values=values)
            tied = self.fit(account.model.with_replaced_effect(index, shared))
            if tied.criterion < account.criterion:
                return tied
        return account


def joint_kinds(joints: Iterable[str]) -> Groups:
    """The same number for joints whose names differ in their first part only: FR_hip_joint, FL_hip_joint."""
    names = [name.partition("_")[2] or name for name in joints]
    found: Groups = np.unique(names, return_inverse=True)[1]
    return found


def joint_groupings(joints: Sequence[str]) -> list[Groups]:
    """By kind, and each joint for itself; by kind only where several joints are of one."""
    each = np.arange(len(joints))
    by_kind = joint_kinds(joints)
    return [by_kind, each] if by_kind.max() + 1 < len(joints) else [each]
