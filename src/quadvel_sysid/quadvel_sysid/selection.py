"""One floating forward search for the effects that a log shows: add, drop, tie.

Candidates are screened on top of the model so far, the most promising are fitted with everything else, and the one with
the least criterion on the rows that select is added if it passes the test. After each step effects that the others made
needless are left out. In the end it is tried what joints share.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import attrs
import numpy as np

from quadvel_actuator.effects import EffectLaw

from .candidates import LAWS, TERMS, Candidates, key
from .criterion import MIN_EFFECT_SIZE, SIGNIFICANCE_LEVEL
from .fitted_model import FittedModel, ModelEvaluator, joint_groupings
from .library import SignalTerm
from .model import AppliedEffect, Model
from .signals import Array

MAX_EFFECTS = 5
"""Effects of one log at most"""
RIVAL_FRACTION = 0.5
"""Of the best candidate's worth: what is worth so much is its rival, which may say the same"""
EQUIVALENCE_MARGIN = 0.02
"""Of a joint's error: laws whose errors differ by less cannot be told apart"""

ProgressText = Callable[[str], None]


class Search:
    """Searches on one set of data."""

    def __init__(self, judge: ModelEvaluator, tick: ProgressText = lambda text: None) -> None:
        self.evaluator, self._on_progress = judge, tick
        self.rejected: dict[str, tuple[float, str]] = {}
        self._tested_count = 1
        self._rivals: dict[tuple[str, ...], set[tuple[str, ...]]] = {}
        self._candidate_cache: dict[tuple[object, ...], Candidates] = {}

    def best(self, start: Model) -> tuple[FittedModel, FittedModel]:
        """The account of the data with the least criterion, and the best one without terms.

        Nothing is sought where a residual is white. Up to two laws are held against one term of named signals. Where these
        laws leave more than noise, terms alone come into question; and where those do so, too, or cost more, further laws,
        and terms on top of the laws.
        """
        plain = self.evaluator.refine_delays(self.evaluator.fit(start))
        if plain.is_white:
            return plain, plain
        laws = self.extend(plain, LAWS, most=1)
        if laws.is_white:
            laws = self.prune(laws)
            return laws, laws
        terms = self.extend(plain, TERMS, most=1)
        laws = self.extend(laws, LAWS, most=2, bound=terms.criterion)
        if not laws.is_white:
            terms = self.extend(terms, TERMS)
        accounts = [terms]
        if laws.is_white or not terms.is_white or laws.criterion < terms.criterion:
            laws = self.prune(self.extend(laws, LAWS, bound=terms.criterion))
            accounts += [laws] if laws.is_white else [laws, self.extend(laws, TERMS, bound=terms.criterion)]
        least = min(one.criterion for one in accounts)
        alike = [
            one for one in accounts if one.criterion < least + EQUIVALENCE_MARGIN * len(self.evaluator.noise)
        ]
        return self.prune(min(alike, key=_regressor_count)), laws

    def residual_correlates(self, account: FittedModel) -> tuple[str, ...]:
        """The signals that what is left goes with most, whether or not a term of them would pay."""
        terms, _ = self._candidates_of(account).found(TERMS)
        best = min(terms, key=lambda one: one.criterion, default=None)
        return () if best is None else best.last_effect.law.inputs  # type: ignore[attr-defined]

    def prune(self, account: FittedModel) -> FittedModel:
        """Without what costs more than it is worth: effects, joints of effects, values and gains of each joint."""
        account = self.eliminate(account)
        for k in range(len(account.model.effects)):
            account = self._replace_by_special_case(
                self.evaluator.restrict_joints(self._replace_by_special_case(account, k), k), k
            )
        model, one = account.model, np.zeros(len(self.evaluator.noise), dtype=np.intp)
        if model.gain_groups.any():
            shared = self.evaluator.fit(
                attrs.evolve(model, gains=_mean_over_joints(model.gains), gain_groups=one)
            )
            account = min(account, shared, key=lambda each: each.criterion)
        if model.delay_groups.any():
            same = attrs.evolve(account.model, delay_groups=one).with_delays(_mean_over_joints(model.delays))
            account = min(account, self.evaluator.fit(same), key=lambda each: each.criterion)
        for k in range(len(account.model.effects)):
            account = self.evaluator.share_across_joints(account, k)
        return account

    def nested_models(self, account: FittedModel) -> list[FittedModel]:
        """The account with fewer of its effects, those that were found first, the most of them first."""
        model = account.model
        return self.evaluator.fit_each(
            [attrs.evolve(model, effects=model.effects[:k]) for k in range(len(model.effects) - 1, 0, -1)]
        )

    def _replace_by_special_case(self, account: FittedModel, index: int) -> FittedModel:
        """With the effect's law replaced by its special case, as Stribeck friction by Coulomb's, unless selecting rows need it."""
        one = account.model.effects[index]
        less = one.law.special_case(dict(zip(one.law.names, one.values, strict=True)))
        if less is None:
            return account
        law, start = less
        values = np.array([start[name] for name in law.names])
        other = self.evaluator.fit(
            account.model.with_replaced_effect(index, attrs.evolve(one, law=law, values=values))
        )
        return account if self._is_needed(other, account) else other

    def extend(
        self, best: FittedModel, kinds: str, most: int = MAX_EFFECTS, bound: float = np.inf
    ) -> FittedModel:
        """The account with candidates of these kinds added while it pays and may come below `bound`.

        Effects are taken to gain less one by one, so that what the last one gained tells how far the others may get.
        """
        while len(best.model.effects) < most and not best.is_white:
            self._on_progress(f"effect {len(best.model.effects) + 1}")
            before, more = best, self._add_best(best, kinds)
            if more is None:
                break
            best = self.evaluator.refine_delays(self.eliminate(more, kept=1))
            gained, left = before.criterion - best.criterion, most - len(best.model.effects)
            if best.criterion - left * gained > bound:
                break
        return best

    def _add_best(self, before: FittedModel, kinds: str) -> FittedModel | None:
        """The account with the candidate more that has the least criterion; None where none passes."""
        candidates = [*self._candidates(before, kinds), *self._finer_groups(before)]
        candidates.sort(key=lambda one: one.criterion)
        self._record_rivals(before, candidates)
        for one in candidates:
            reason = self._rejection_reason(before, one)
            if not reason:
                return one
            if len(one.model.effects) > len(before.model.effects):
                self.rejected.setdefault(one.last_effect.law.name, (one.compare_with(before).gain, reason))
        return None

    def _record_rivals(self, before: FittedModel, candidates: Sequence[FittedModel]) -> None:
        """Keep in mind what is worth nearly as much as the best candidate: it may say the same."""
        fall = [before.criterion - one.criterion for one in candidates]
        if fall:
            near = {
                key(one.last_effect.law)
                for one, by in zip(candidates, fall, strict=True)
                if len(one.model.effects) > len(before.model.effects) and by > RIVAL_FRACTION * fall[0]
            }
            for name in near:
                self._rivals.setdefault(name, set()).update(near)

    def _rejection_reason(self, before: FittedModel, after: FittedModel) -> str:
        """Why what was added does not count; nothing where it does."""
        grown = len(after.model.effects) > len(before.model.effects)
        if grown and duplicates_effect(after.last_effect, before.model.effects):
            return "a law that it contains, or that contains it, is on the same joints already"
        if grown and not after.last_effect.is_excited(after.model.signals):
            return "the joints moved too little to tell it from other laws"
        found = after.compare_with(before)
        p = found.p * self._tested_count
        worth = float(np.max(found.share))
        if p >= SIGNIFICANCE_LEVEL:
            return f"not significant on rows that select (p = {min(p, 1.0):.2g} after {self._tested_count} candidates)"
        if worth <= MIN_EFFECT_SIZE:
            return f"takes {100 * worth:.1f} % off the error of a joint, below {100 * MIN_EFFECT_SIZE:.0f} %"
        return "" if after.criterion < before.criterion else "costs more parameters than it is worth"

    def _candidates_of(self, before: FittedModel) -> Candidates:
        """The candidates on top of an account; kept, as several searches come by."""
        model = _structure_key(before.model)
        if model not in self._candidate_cache:
            self._candidate_cache[model] = Candidates(before)
        return self._candidate_cache[model]

    def _candidates(self, before: FittedModel, kinds: str) -> list[FittedModel]:
        """The most promising candidates of these kinds on top of an account, fitted."""
        found, self._tested_count = self._candidates_of(before).found(kinds)
        return found

    def _finer_groups(self, before: FittedModel) -> list[FittedModel]:
        """The account with gains, or delays, for each kind of joint and for each joint."""
        model, joints = before.model, before.model.samples.joints
        found = []
        for groups in joint_groupings(joints):
            finer = len(np.unique(groups))
            if finer > len(np.unique(model.gain_groups)):
                found.append(attrs.evolve(model, gain_groups=groups))
            if finer > len(np.unique(model.delay_groups)):
                found.append(attrs.evolve(model, delay_groups=groups))
        return self.evaluator.fit_each(found)

    def eliminate(self, account: FittedModel, kept: int = 0) -> FittedModel:
        """Without the effects that the others made needless (backward elimination), but with the last `kept` ones."""
        while len(account.model.effects) > max(kept, 1):
            model = account.model
            among = range(len(model.effects) - kept)
            least = min(
                self.evaluator.fit_each([model.without_effect(k) for k in among]),
                key=lambda one: one.criterion,
            )
            if self._is_needed(least, account):
                return account
            account = least
        return account

    def _is_needed(self, without: FittedModel, account: FittedModel) -> bool:
        found = account.compare_with(without)
        worth = float(np.max(found.share))
        return (
            account.criterion < without.criterion and worth > MIN_EFFECT_SIZE and found.p < SIGNIFICANCE_LEVEL
        )

    def indistinguishable_effects(self, account: FittedModel, index: int) -> tuple[str, ...]:
        """The laws that say the same in the place of an effect, to what rows that select can tell."""
        one = account.model.effects[index].law
        if isinstance(one, SignalTerm):
            return ()
        rest = self.evaluator.fit(account.model.without_effect(index))
        alone = len(account.model.effects) == 1
        pool = self._candidates_of(rest) if alone else Candidates(rest, self._rivals.get(key(one), set()))
        found = []
        for other in pool.found(LAWS)[0]:
            lost = account.compare_with(other)
            if other.last_effect.law.name != one.name and (lost.share < EQUIVALENCE_MARGIN).all():
                found.append(other.last_effect.law.name)
        return tuple(dict.fromkeys(found))


def _regressor_count(account: FittedModel) -> tuple[int, float]:
    """How many terms of named signals there are in an account, whose laws say more to who reads them; and its criterion."""
    return sum(isinstance(one.law, SignalTerm) for one in account.model.effects), account.criterion


def duplicates_effect(one: AppliedEffect, others: Iterable[AppliedEffect]) -> bool:
    """Does a law act where a law is at work that it contains as an end of its parameters, or that contains it?"""
    mine = _effect_family(one.law)
    return any(
        not (one.active & ~other.active).any() and mine & _effect_family(other.law) for other in others
    )


def _effect_family(law: EffectLaw) -> set[str]:
    """The names of a law and of that which it becomes at the end of one of its parameters; none of a term."""
    if isinstance(law, SignalTerm):
        return set()
    less = law.special_case({p.name: np.array([p.scale]) for p in law.parameters})
    return {law.name} | ({less[0].name} if less else set())


def _structure_key(model: Model) -> tuple[object, ...]:
    """What tells two fitted models apart: their laws, forms and joints, and what is shared."""
    effects = [
        (one.law.name, str(one.law.settings), one.active.tobytes(), one.groups.tobytes())
        for one in model.effects
    ]
    return (*sorted(effects), model.gain_groups.tobytes(), model.delay_groups.tobytes())


def _mean_over_joints(values: Array) -> Array:
    """The mean over the joints, for each of them."""
    return np.repeat(values.mean(axis=-1, keepdims=True), values.shape[-1], axis=-1)
