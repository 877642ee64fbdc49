"""Floating forward search for the effects that a log shows: add, drop, share.

Each step screens the candidates on top of the present model, and fits the best ones together with
everything else. It adds the candidate with the lowest criterion on the selection rows, if the
candidate passes the score test. Backward elimination then removes effects that became unnecessary.
At the end the search tests which values joints share.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools

from ..model.applied_effect import AppliedEffect
from ..model.effect_candidate import EffectCandidate
from ..model.torque_model import Model
from ..statistics.criterion import (
    MAX_UNEXPLAINED_SHARE,
    MIN_EFFECT_SIZE,
    MIN_REMOVABLE_SHARE,
    READING_ERROR_MARGIN,
    SIGNIFICANCE_LEVEL,
    Comparison,
)
from .candidates import EFFECTS, REGRESSORS, Candidates
from .fitted_model import RIVAL_FRACTION, FittedModel, ModelEvaluator
from .regressors import RegressorCandidate

MAX_EFFECTS = 5
"""Maximum number of effects of one log."""
EQUIVALENCE_MARGIN = 0.02
"""Relative difference of a joint's error below which two effects are indistinguishable."""

ProgressText = Callable[[str], None]


@attrs.frozen
class SearchRecord:
    """Candidates that a search did not choose.

    Attributes:
        rejected: Rejected effects by name: gain on the selection rows (N^2 m^2), and the reason.
        rivals: For the key of each candidate, the keys of those that nearly equalled it.
    """

    rejected: dict[str, tuple[float, str]] = attrs.field(factory=dict)
    rivals: dict[tuple[str, ...], set[tuple[str, ...]]] = attrs.field(factory=dict)

    def add_rivals(self, before: FittedModel, candidates: Sequence[FittedModel]) -> None:
        """Store which candidates nearly equal the best one, for `indistinguishable_effects`.

        Args:
            before: The model before.
            candidates: Models with one change, the best one first.
        """
        gains = [before.criterion - candidate.criterion for candidate in candidates]
        if gains:
            near = {
                one.last_effect.candidate.key
                for one, gain in zip(candidates, gains, strict=True)
                if len(one.model.effects) > len(before.model.effects) and gain > RIVAL_FRACTION * gains[0]
            }
            for key in near:
                self.rivals.setdefault(key, set()).update(near)


@attrs.frozen
class SearchResult:
    """Result of a search.

    Attributes:
        best: The best model.
        best_effects: The best model without regressors of named signals.
        record: Candidates that were not chosen.
    """

    best: FittedModel
    best_effects: FittedModel
    record: SearchRecord


class Search:
    """Search for the effects of one set of data.

    Attributes:
        evaluator: Data that models are fitted to and compared on.
    """

    def __init__(self, evaluator: ModelEvaluator, on_progress: ProgressText = lambda text: None) -> None:
        """Prepare a search.

        Args:
            evaluator: Data that models are fitted to and compared on.
            on_progress: Receives a short text before each step.
        """
        self.evaluator, self._options, self._on_progress = evaluator, evaluator.options, on_progress
        self._candidate_cache: dict[tuple[object, ...], Candidates] = {}
        self._removable = np.zeros(len(evaluator.noise))  # of each joint, N^2 m^2

    def best(self, start: Model) -> SearchResult:
        """Find the model with the lowest criterion.

        The search ends at once where the plain model leaves a white residual. Up to two effects
        compete with one regressor of named signals. If two effects leave a structured residual, the
        search tries regressors alone. If these leave structure too, or cost more, it tries further
        effects, and regressors on top.

        Args:
            start: The plain EAM.

        Returns:
            The best model, the best one without regressors of named signals, and what was not
            chosen.
        """
        record = SearchRecord()
        plain = self.evaluator.refine_delays(self.evaluator.fit(start))
        if plain.is_white:
            return SearchResult(plain, plain, record)
        self._removable = np.maximum(plain.selection_mse - self.evaluator.noise, 0.0)
        # One effect that leaves white noise needs no comparison.
        effects = self.extend(plain, EFFECTS, record, most=1)
        if effects.is_white:
            effects = self.prune(effects)
            return SearchResult(effects, effects, record)
        # Otherwise up to two effects compete with one regressor of named signals.
        regressors = self.extend(plain, REGRESSORS, record, most=1)
        effects = self._with_special_cases(
            self.extend(effects, EFFECTS, record, most=2, bound=regressors.criterion)
        )
        if not effects.is_white:
            regressors = self.extend(regressors, REGRESSORS, record)
        # Among models with nearly equal criteria the one with the fewest regressors counts.
        models, bound = [regressors], regressors.criterion
        is_close = self._is_nearly_as_good(effects, regressors, plain)
        if effects.is_white or not regressors.is_white or is_close:
            effects = self.prune(self.extend(effects, EFFECTS, record, bound=bound))
            models.append(effects)
            if not effects.is_white:
                models.append(self.extend(effects, REGRESSORS, record, bound=bound))
        least = min(models, key=lambda one: one.criterion)
        equivalent = [one for one in models if self._is_nearly_as_good(one, least, plain)]
        key = _regressors_then_groups if self._options.effects_before_regressors else _criterion
        return SearchResult(self.prune(min(equivalent, key=key)), effects, record)

    def _is_nearly_as_good(self, fitted: FittedModel, best: FittedModel, plain: FittedModel) -> bool:
        """Whether a model is preferred to the best one if it is simpler."""
        margin = EQUIVALENCE_MARGIN * len(self.evaluator.noise)
        return fitted.criterion < best.criterion + margin or self._explains_nearly_all(fitted, best, plain)

    def _explains_nearly_all(self, fitted: FittedModel, best: FittedModel, plain: FittedModel) -> bool:
        """Whether a model leaves a small share of what the best model explains, relative to the noise.

        A learned term adapts to the rows and to the noise of states between them; the form of an
        effect does not.
        """
        left, explained = (
            float(np.sum(one.relative_errors - best.relative_errors)) for one in (fitted, plain)
        )
        return left <= MAX_UNEXPLAINED_SHARE * explained

    def residual_correlates(self, fitted: FittedModel) -> tuple[str, ...]:
        """Return the signals that the residual depends on, by the score test of a regressor of them.

        Args:
            fitted: A fitted model.

        Returns:
            Names of signals; none if no regressor is significant and of the minimum effect size.
        """
        found = self._candidates_of(fitted).fitted_candidates(REGRESSORS)
        best = min(found.models, key=lambda one: one.criterion, default=None)
        if best is None:
            return ()
        comparison = best.compare_with(fitted)
        is_significant = comparison.p_value * found.tested_count < SIGNIFICANCE_LEVEL
        return best.last_effect.candidate.key if is_significant and self._is_large(comparison) else ()

    def prune(self, fitted: FittedModel) -> FittedModel:
        """Simplify a model: fewer effects and joints, special cases, shared values and gains.

        Args:
            fitted: A fitted model.

        Returns:
            The simplified model; its criterion on the selection rows is not significantly worse.
        """
        fitted = self.eliminate(fitted)
        for k in range(len(fitted.model.effects)):
            fitted = self._replace_by_special_case(
                self.evaluator.restrict_joints(self._replace_by_special_case(fitted, k), k), k
            )
        model, common = fitted.model, np.zeros(len(self.evaluator.noise), dtype=np.intp)
        if model.gain_groups.any():
            shared = self.evaluator.fit(
                attrs.evolve(model, gains=_mean_over_joints(model.gains), gain_groups=common)
            )
            fitted = min(fitted, shared, key=lambda each: each.criterion)
        if model.delay_groups.any():
            same = attrs.evolve(fitted.model, delay_groups=common).with_delays(
                _mean_over_joints(model.delays)
            )
            fitted = min(fitted, self.evaluator.fit(same), key=lambda each: each.criterion)
        for k in range(len(fitted.model.effects)):
            fitted = self.evaluator.share_across_joints(fitted, k)
        return fitted

    def nested_models(self, fitted: FittedModel) -> list[FittedModel]:
        """Fit the nested models with the first effects only.

        Args:
            fitted: A fitted model with n effects.

        Returns:
            Models with n-1, n-2, ..., 1 effects, in the order in which the effects were found.
        """
        whole = fitted.model
        return self.evaluator.fit_each(
            [attrs.evolve(whole, effects=whole.effects[:k]) for k in range(len(whole.effects) - 1, 0, -1)]
        )

    def _replace_by_special_case(self, fitted: FittedModel, index: int) -> FittedModel:
        """Replace an effect by its special case (Stribeck by Coulomb friction), unless rows need it."""
        if not self._options.special_cases:
            return fitted
        effect = fitted.model.effects[index]
        special_case = effect.candidate.special_case(effect.parameters)
        if special_case is None:
            return fitted
        candidate, start = special_case
        values = np.array([start[name] for name in candidate.names])
        simpler = self.evaluator.fit(
            fitted.model.with_replaced_effect(index, attrs.evolve(effect, candidate=candidate, values=values))
        )
        return fitted if self._is_needed(simpler, fitted) else simpler

    def _with_special_cases(self, fitted: FittedModel) -> FittedModel:
        """Replace effects by special cases that lower the criterion.

        The general case may have its best parameters at infinity: a constant torque is a spring
        without stiffness that rests infinitely far away.
        """
        if not fitted.is_white:
            for k in range(len(fitted.model.effects)):
                simpler = self._replace_by_special_case(fitted, k)
                fitted = min(fitted, simpler, key=lambda one: one.criterion)
        return fitted

    def extend(
        self,
        best: FittedModel,
        kinds: str,
        record: SearchRecord,
        most: int = MAX_EFFECTS,
        bound: float = np.inf,
    ) -> FittedModel:
        """Add candidates while that lowers the criterion.

        The gain of successive effects is assumed to decrease. The gain of the last effect therefore
        bounds what the remaining effects can reach.

        Args:
            best: Model to extend.
            kinds: `candidates.EFFECTS` or `candidates.REGRESSORS`.
            record: Receives the candidates that are not chosen.
            most: Maximum number of effects.
            bound: Criterion that the result has to reach; the search stops when it cannot.

        Returns:
            The extended model, or `best`.
        """
        while len(best.model.effects) < most and not best.is_white:
            self._on_progress(f"effect {len(best.model.effects) + 1}")
            before, more = best, self._add_best(best, kinds, record)
            if more is None:
                break
            best = self.evaluator.refine_delays(self.eliminate(more, kept=1))
            # Further effects gain at most as much as the last one each.
            gained, left = before.criterion - best.criterion, most - len(best.model.effects)
            if best.criterion - left * gained > bound:
                break
        return best

    def _add_best(self, before: FittedModel, kinds: str, record: SearchRecord) -> FittedModel | None:
        """The model with the best candidate added; None if no candidate passes the test."""
        fitted = self._candidates_of(before).fitted_candidates(kinds)
        best = min((one.criterion for one in fitted.models), default=before.criterion)
        limit = before.criterion - RIVAL_FRACTION * max(before.criterion - best, 0.0)
        rivals = self.evaluator.finer_groupings(before, limit)
        candidates = sorted([*fitted.models, *rivals], key=lambda one: one.criterion)
        if candidates and candidates[0] in rivals and kinds == EFFECTS:
            # An effect on some joints is simpler than gains of each joint.
            simpler = [one for one in fitted.models if self._explains_nearly_all(one, candidates[0], before)]
            candidates.sort(key=lambda one: one not in simpler)
        record.add_rivals(before, candidates)
        accepted = self._first_accepted(before, candidates, fitted.tested_count, record)
        if accepted is None and limit < before.criterion:
            others = self.evaluator.finer_groupings(before, before.criterion)
            accepted = self._first_accepted(before, others, fitted.tested_count, record)
        return accepted

    def _first_accepted(
        self, before: FittedModel, candidates: Sequence[FittedModel], tested_count: int, record: SearchRecord
    ) -> FittedModel | None:
        """The first candidate that passes the test, if any; `record` receives the others."""
        for candidate in candidates:
            reason = self._rejection_reason(before, candidate, tested_count)
            if not reason:
                return candidate
            if len(candidate.model.effects) > len(before.model.effects):
                gain = candidate.compare_with(before).gain
                record.rejected.setdefault(candidate.last_effect.candidate.name, (gain, reason))
        return None

    def _rejection_reason(self, before: FittedModel, after: FittedModel, tested_count: int) -> str:
        """Reason why an added effect is rejected; empty if it is accepted."""
        grown = len(after.model.effects) > len(before.model.effects)
        if grown and self._options.no_repeats and duplicates_effect(after.last_effect, before.model.effects):
            return "the same joints already have an effect that is its special or its general case"
        if grown and not after.last_effect.is_excited(after.model.signals):
            return "the joints moved too little to distinguish it from other effects"
        comparison = after.compare_with(before)
        p = comparison.p_value * tested_count
        relative_gain = float(np.max(comparison.relative_gain))
        if p >= SIGNIFICANCE_LEVEL:
            return (
                f"not significant on rows that select (p = {min(p, 1.0):.2g} after {tested_count} candidates)"
            )
        if relative_gain <= MIN_EFFECT_SIZE:
            return f"reduces the error of a joint by {100 * relative_gain:.1f} %, below {100 * MIN_EFFECT_SIZE:.0f} %"
        if not (self._is_large(comparison) if grown else self._is_large_on_a_joint(comparison)):
            return (
                f"reduces the error of each joint by less than {100 * MIN_REMOVABLE_SHARE:.0f} % of what the plain EAM leaves "
                "above the noise, or by less than unknown instants of the drive may cause"
            )
        return "" if after.criterion < before.criterion else "its gain is below the cost of its parameters"

    def _candidates_of(self, before: FittedModel) -> Candidates:
        """Candidates on top of a model, from the cache if several searches reach the same model."""
        structure = _structure_key(before.model)
        if structure not in self._candidate_cache:
            self._candidate_cache[structure] = Candidates(before)
        return self._candidate_cache[structure]

    def eliminate(self, fitted: FittedModel, kept: int = 0) -> FittedModel:
        """Remove effects that are no longer significant (backward elimination).

        Args:
            fitted: A fitted model.
            kept: Number of effects at the end that are not removed.

        Returns:
            The model with the necessary effects.
        """
        while self._options.elimination and len(fitted.model.effects) > max(kept, 1):
            removable = range(len(fitted.model.effects) - kept)
            without = self.evaluator.fit_each([fitted.model.without_effect(k) for k in removable])
            reduced = min(without, key=lambda one: one.criterion)
            if self._is_needed(reduced, fitted):
                # The split of the delays may have been fitted together with the effect.
                confounded = [fitted.model.effects[k].candidate.confounded_with_delays for k in removable]
                split = [self.evaluator.refine_split(without[k]) for k in np.flatnonzero(confounded)]
                reduced = min([reduced, *split], key=lambda one: one.criterion)
                if reduced not in split or self._is_needed(reduced, fitted):
                    return fitted
            fitted = reduced
        return fitted

    def _is_needed(self, without: FittedModel, fitted: FittedModel) -> bool:
        """Whether the model is significantly better than the one without the effect."""
        comparison = fitted.compare_with(without)
        return (
            fitted.criterion < without.criterion
            and self._is_large(comparison)
            and comparison.p_value < SIGNIFICANCE_LEVEL
        )

    def _is_large(self, comparison: Comparison) -> bool:
        """Whether an effect reduces the error of some joint by more than the minimum effect size.

        Where the form of a strong effect is not quite right, further effects make up for a per cent of
        it, with any significance. Others make up for states that are read at the wrong instant.
        """
        changed = comparison.noise.any(axis=0)
        read = READING_ERROR_MARGIN * self.evaluator.reading_error
        return bool(
            self._is_above_form_error(comparison).any()
            and comparison.joint_gain[changed].sum() > read[changed].sum()
        )

    def _is_large_on_a_joint(self, comparison: Comparison) -> bool:
        """The same for gains and delays of each joint, of which all but one may be right already."""
        above = self._is_above_form_error(comparison)
        read = READING_ERROR_MARGIN * self.evaluator.reading_error
        return bool((above & (comparison.joint_gain > read)).any())

    def _is_above_form_error(self, comparison: Comparison) -> Bools:
        """Joints (J,) whose error falls by more than a slightly wrong form of another effect makes up."""
        above: Bools = (comparison.relative_gain > MIN_EFFECT_SIZE) & (
            comparison.joint_gain > MIN_REMOVABLE_SHARE * self._removable
        )
        return above

    def indistinguishable_effects(
        self, fitted: FittedModel, index: int, record: SearchRecord
    ) -> tuple[str, ...]:
        """List other effects that explain the selection rows equally well in place of an effect.

        Args:
            fitted: A fitted model.
            index: Index of the effect.
            record: Record of the search that found the model.

        Returns:
            Names of effects whose error on every joint differs by less than `EQUIVALENCE_MARGIN`.
        """
        candidate = fitted.model.effects[index].candidate
        if isinstance(candidate, RegressorCandidate):
            return ()
        rest = self.evaluator.fit(fitted.model.without_effect(index))
        alone = len(fitted.model.effects) == 1
        rivals = record.rivals.get(candidate.key, set())
        pool = self._candidates_of(rest) if alone else Candidates(rest, rivals)
        found = []
        for other in pool.fitted_candidates(EFFECTS).models:
            name = other.last_effect.candidate.name
            gain = fitted.compare_with(other).relative_gain
            if name != candidate.name and (gain < EQUIVALENCE_MARGIN).all():
                found.append(name)
        return tuple(dict.fromkeys(found))


def _regressors_then_groups(fitted: FittedModel) -> tuple[int, int, float]:
    """Numbers of regressors and of groups of joints, then the criterion: effects are easier to interpret."""
    count = sum(isinstance(effect.candidate, RegressorCandidate) for effect in fitted.model.effects)
    groups = sum(len(np.unique(one)) for one in (fitted.model.gain_groups, fitted.model.delay_groups))
    return count, groups, fitted.criterion


def _criterion(fitted: FittedModel) -> tuple[int, int, float]:
    """The criterion alone, as a key."""
    return 0, 0, fitted.criterion


def duplicates_effect(effect: AppliedEffect, others: Iterable[AppliedEffect]) -> bool:
    """Whether an effect is nested with one that acts on the same joints already.

    Args:
        effect: The added effect.
        others: Effects of the model before.

    Returns:
        True if one is the special case of the other, or the same, on all joints of `effect`.
    """
    mine = _effect_family(effect.candidate)
    return any(
        not (effect.active & ~other.active).any() and mine & _effect_family(other.candidate)
        for other in others
    )


def _effect_family(candidate: EffectCandidate) -> set[str]:
    """Names of an effect and of its special case; empty for a regressor of named signals."""
    if isinstance(candidate, RegressorCandidate):
        return set()
    special_case = candidate.special_case({p.name: np.array([p.scale]) for p in candidate.parameters})
    return {candidate.name} | ({special_case[0].name} if special_case else set())


def _structure_key(model: Model) -> tuple[object, ...]:
    """Key of a model's structure: effects, forms, joints and groups."""
    effects = [
        (
            effect.candidate.name,
            str(effect.candidate.effect.settings),
            effect.active.tobytes(),
            effect.groups.tobytes(),
        )
        for effect in model.effects
    ]
    return (*sorted(effects), model.gain_groups.tobytes(), model.delay_groups.tobytes())


def _mean_over_joints(values: Array) -> Array:
    """Mean over the joints, repeated for each joint."""
    return np.repeat(values.mean(axis=-1, keepdims=True), values.shape[-1], axis=-1)
