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

from quadvel_actuator.effects import EffectLaw
from quadvel_description.arrays import Array

from ..model.torque_model import AppliedEffect, Model
from ..statistics.criterion import MIN_EFFECT_SIZE, SIGNIFICANCE_LEVEL
from .candidates import LAWS, TERMS, Candidates, candidate_key
from .fitted_model import FittedModel, ModelEvaluator, joint_groupings
from .library import SignalTerm

MAX_EFFECTS = 5
"""Maximum number of effects of one log."""
RIVAL_FRACTION = 0.5
"""Fraction of the best candidate's gain above which another candidate is its rival."""
EQUIVALENCE_MARGIN = 0.02
"""Relative difference of a joint's error below which two laws are indistinguishable."""

ProgressText = Callable[[str], None]


class Search:
    """Search for the effects of one set of data.

    Attributes:
        evaluator: Data that models are fitted to and compared on.
        rejected: Rejected effects by name: gain on the selection rows (N^2 m^2), and the reason.
    """

    def __init__(self, evaluator: ModelEvaluator, on_progress: ProgressText = lambda text: None) -> None:
        """Start a search.

        Args:
            evaluator: Data that models are fitted to and compared on.
            on_progress: Receives a short text before each step.
        """
        self.evaluator, self._devices, self._on_progress = evaluator, evaluator.devices, on_progress
        self.rejected: dict[str, tuple[float, str]] = {}
        self._tested_count = 1
        self._rivals: dict[tuple[str, ...], set[tuple[str, ...]]] = {}
        self._candidate_cache: dict[tuple[object, ...], Candidates] = {}

    def best(self, start: Model) -> tuple[FittedModel, FittedModel]:
        """Find the model with the lowest criterion.

        The search ends at once where the plain model leaves a white residual. Up to two laws
        compete with one regressor of named signals. If two laws leave a structured residual, the
        search tries regressors alone. If these leave structure too, or cost more, it tries further
        laws, and regressors on top.

        Args:
            start: The plain EAM.

        Returns:
            The best model, and the best model without regressors of named signals.
        """
        plain = self.evaluator.refine_delays(self.evaluator.fit(start))
        if plain.is_white:
            return plain, plain
        # One law that leaves white noise needs no comparison.
        laws = self.extend(plain, LAWS, most=1)
        if laws.is_white:
            laws = self.prune(laws)
            return laws, laws
        # Otherwise up to two laws compete with one regressor of named signals.
        terms = self.extend(plain, TERMS, most=1)
        laws = self.extend(laws, LAWS, most=2, bound=terms.criterion)
        if not laws.is_white:
            terms = self.extend(terms, TERMS)
        models = [terms]
        if laws.is_white or not terms.is_white or laws.criterion < terms.criterion:
            laws = self.prune(self.extend(laws, LAWS, bound=terms.criterion))
            models += [laws] if laws.is_white else [laws, self.extend(laws, TERMS, bound=terms.criterion)]
        # Among models with nearly equal criteria the one with the fewest regressors counts.
        if not self._devices.laws_before_terms:
            return self.prune(min(models, key=lambda one: one.criterion)), laws
        least = min(one.criterion for one in models)
        margin = EQUIVALENCE_MARGIN * len(self.evaluator.noise)
        equivalent = [one for one in models if one.criterion < least + margin]
        return self.prune(min(equivalent, key=_term_count)), laws

    def residual_correlates(self, fitted: FittedModel) -> tuple[str, ...]:
        """Return the signals that the residual correlates with most.

        Args:
            fitted: A fitted model.

        Returns:
            Names of signals, even if a regressor of them would not pay for its parameters.
        """
        terms, _ = self._candidates_of(fitted).fitted_candidates(TERMS)
        best = min(terms, key=lambda one: one.criterion, default=None)
        return () if best is None else best.last_effect.law.input_signals  # type: ignore[attr-defined]

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
        """Replace a law by its special case (Stribeck by Coulomb friction), unless rows need it."""
        if not self._devices.special_cases:
            return fitted
        effect = fitted.model.effects[index]
        special_case = effect.law.special_case(dict(zip(effect.law.names, effect.values, strict=True)))
        if special_case is None:
            return fitted
        law, start = special_case
        values = np.array([start[name] for name in law.names])
        simpler = self.evaluator.fit(
            fitted.model.with_replaced_effect(index, attrs.evolve(effect, law=law, values=values))
        )
        return fitted if self._is_needed(simpler, fitted) else simpler

    def extend(
        self, best: FittedModel, kinds: str, most: int = MAX_EFFECTS, bound: float = np.inf
    ) -> FittedModel:
        """Add candidates while that lowers the criterion.

        The gain of successive effects is assumed to decrease. The gain of the last effect therefore
        bounds what the remaining effects can reach.

        Args:
            best: Model to extend.
            kinds: `candidates.LAWS` or `candidates.TERMS`.
            most: Maximum number of effects.
            bound: Criterion that the result has to reach; the search stops when it cannot.

        Returns:
            The extended model, or `best`.
        """
        while len(best.model.effects) < most and not best.is_white:
            self._on_progress(f"effect {len(best.model.effects) + 1}")
            before, more = best, self._add_best(best, kinds)
            if more is None:
                break
            best = self.evaluator.refine_delays(self.eliminate(more, kept=1))
            # Further effects gain at most as much as the last one each.
            gained, left = before.criterion - best.criterion, most - len(best.model.effects)
            if best.criterion - left * gained > bound:
                break
        return best

    def _add_best(self, before: FittedModel, kinds: str) -> FittedModel | None:
        """The model with the best candidate added; None if no candidate passes the test."""
        candidates = [*self._candidates(before, kinds), *self._finer_groupings(before)]
        candidates.sort(key=lambda one: one.criterion)
        self._record_rivals(before, candidates)
        for candidate in candidates:
            reason = self._rejection_reason(before, candidate)
            if not reason:
                return candidate
            if len(candidate.model.effects) > len(before.model.effects):
                self.rejected.setdefault(
                    candidate.last_effect.law.name, (candidate.compare_with(before).gain, reason)
                )
        return None

    def _record_rivals(self, before: FittedModel, candidates: Sequence[FittedModel]) -> None:
        """Store which candidates nearly equal the best one, for `indistinguishable_effects`."""
        gains = [before.criterion - candidate.criterion for candidate in candidates]
        if gains:
            near = {
                candidate_key(candidate.last_effect.law)
                for candidate, gain in zip(candidates, gains, strict=True)
                if len(candidate.model.effects) > len(before.model.effects)
                and gain > RIVAL_FRACTION * gains[0]
            }
            for name in near:
                self._rivals.setdefault(name, set()).update(near)

    def _rejection_reason(self, before: FittedModel, after: FittedModel) -> str:
        """Reason why an added effect is rejected; empty if it is accepted."""
        grown = len(after.model.effects) > len(before.model.effects)
        if grown and self._devices.no_repeats and duplicates_effect(after.last_effect, before.model.effects):
            return "the same joints already have a law that is its special or its general case"
        if grown and not after.last_effect.is_excited(after.model.signals):
            return "the joints moved too little to distinguish it from other laws"
        comparison = after.compare_with(before)
        p = comparison.p_value * self._tested_count
        relative_gain = float(np.max(comparison.relative_gain))
        if p >= SIGNIFICANCE_LEVEL:
            return f"not significant on rows that select (p = {min(p, 1.0):.2g} after {self._tested_count} candidates)"
        if relative_gain <= MIN_EFFECT_SIZE:
            return f"reduces the error of a joint by {100 * relative_gain:.1f} %, below {100 * MIN_EFFECT_SIZE:.0f} %"
        return "" if after.criterion < before.criterion else "its gain is below the cost of its parameters"

    def _candidates_of(self, before: FittedModel) -> Candidates:
        """Candidates on top of a model, from the cache if several searches reach the same model."""
        structure = _structure_key(before.model)
        if structure not in self._candidate_cache:
            self._candidate_cache[structure] = Candidates(before)
        return self._candidate_cache[structure]

    def _candidates(self, before: FittedModel, kinds: str) -> list[FittedModel]:
        """The best candidates of these kinds on top of a model, fitted."""
        found, self._tested_count = self._candidates_of(before).fitted_candidates(kinds)
        return found

    def _finer_groupings(self, before: FittedModel) -> list[FittedModel]:
        """Models with gains, or delays, for each kind of joint and for each joint."""
        model, joints = before.model, before.model.samples.joints
        found = []
        for groups in joint_groupings(joints) if self._devices.gains_of_each_joint else ():
            finer = len(np.unique(groups))
            if finer > len(np.unique(model.gain_groups)):
                found.append(attrs.evolve(model, gain_groups=groups))
            if finer > len(np.unique(model.delay_groups)):
                found.append(attrs.evolve(model, delay_groups=groups))
        return self.evaluator.fit_each(found)

    def eliminate(self, fitted: FittedModel, kept: int = 0) -> FittedModel:
        """Remove effects that are no longer significant (backward elimination).

        Args:
            fitted: A fitted model.
            kept: Number of effects at the end that are not removed.

        Returns:
            The model with the necessary effects.
        """
        while self._devices.elimination and len(fitted.model.effects) > max(kept, 1):
            model = fitted.model
            removable = range(len(model.effects) - kept)
            reduced = min(
                self.evaluator.fit_each([model.without_effect(k) for k in removable]),
                key=lambda one: one.criterion,
            )
            if self._is_needed(reduced, fitted):
                return fitted
            fitted = reduced
        return fitted

    def _is_needed(self, without: FittedModel, fitted: FittedModel) -> bool:
        """Whether the model is significantly better than the one without the effect."""
        comparison = fitted.compare_with(without)
        relative_gain = float(np.max(comparison.relative_gain))
        return (
            fitted.criterion < without.criterion
            and relative_gain > MIN_EFFECT_SIZE
            and comparison.p_value < SIGNIFICANCE_LEVEL
        )

    def indistinguishable_effects(self, fitted: FittedModel, index: int) -> tuple[str, ...]:
        """List other laws that explain the selection rows equally well in place of an effect.

        Args:
            fitted: A fitted model.
            index: Index of the effect.

        Returns:
            Names of laws whose error on every joint differs by less than `EQUIVALENCE_MARGIN`.
        """
        law = fitted.model.effects[index].law
        if isinstance(law, SignalTerm):
            return ()
        rest = self.evaluator.fit(fitted.model.without_effect(index))
        alone = len(fitted.model.effects) == 1
        pool = (
            self._candidates_of(rest)
            if alone
            else Candidates(rest, self._rivals.get(candidate_key(law), set()))
        )
        found = []
        for other in pool.fitted_candidates(LAWS)[0]:
            comparison = fitted.compare_with(other)
            if (
                other.last_effect.law.name != law.name
                and (comparison.relative_gain < EQUIVALENCE_MARGIN).all()
            ):
                found.append(other.last_effect.law.name)
        return tuple(dict.fromkeys(found))


def _term_count(fitted: FittedModel) -> tuple[int, float]:
    """Number of regressors of named signals, then the criterion: laws are easier to interpret."""
    return sum(isinstance(effect.law, SignalTerm) for effect in fitted.model.effects), fitted.criterion


def duplicates_effect(effect: AppliedEffect, others: Iterable[AppliedEffect]) -> bool:
    """Whether an effect is nested with one that acts on the same joints already.

    Args:
        effect: The added effect.
        others: Effects of the model before.

    Returns:
        True if one law is the special case of the other, or the same, on all joints of `one`.
    """
    mine = _effect_family(effect.law)
    return any(
        not (effect.active & ~other.active).any() and mine & _effect_family(other.law) for other in others
    )


def _effect_family(law: EffectLaw) -> set[str]:
    """Names of a law and of its special case; empty for a regressor of named signals."""
    if isinstance(law, SignalTerm):
        return set()
    special_case = law.special_case({p.name: np.array([p.scale]) for p in law.parameters})
    return {law.name} | ({special_case[0].name} if special_case else set())


def _structure_key(model: Model) -> tuple[object, ...]:
    """Key of a model's structure: laws, forms, joints and groups."""
    effects = [
        (effect.law.name, str(effect.law.settings), effect.active.tobytes(), effect.groups.tobytes())
        for effect in model.effects
    ]
    return (*sorted(effects), model.gain_groups.tobytes(), model.delay_groups.tobytes())


def _mean_over_joints(values: Array) -> Array:
    """Mean over the joints, repeated for each joint."""
    return np.repeat(values.mean(axis=-1, keepdims=True), values.shape[-1], axis=-1)
