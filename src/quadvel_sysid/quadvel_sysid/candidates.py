"""The candidates on top of an account: screened, and the most promising fitted with everything else."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import cached_property
from typing import TypeVar

import attrs
import numpy as np

from quadvel_actuator.effects import EffectLaw

from . import library
from .fit import fit, fit_near_delays
from .fitted_model import FittedModel
from .library import Context, SignalTerm
from .model import Model
from .parallel import side_by_side
from .screening import CandidateScreening, ScreenedCandidate, best_first
from .signals import Bools

FITTED, FITTED_TERMS = 6, 4
"""Laws, and terms, that are fitted after a screening"""
SIMPLIFIED = 3
"""Of these, the best, of which it is tried what their joints share"""
LAWS, TERMS = "laws", "terms"
L = TypeVar("L", bound=EffectLaw)
R = TypeVar("R")


class Candidates:
    """The candidates on top of an account, fitted, the most promising first."""

    def __init__(self, before: FittedModel, among: Collection[tuple[str, ...]] | None = None) -> None:
        """`among`: the names of laws, and signals of terms, that are looked at; all without it."""
        self._before, self._judge, self._among = before, before.evaluator, among
        self._context = Context(before.model, before.evaluator.parts, before.evaluator.noise)

    def _asked(self, candidates: Iterable[L]) -> Iterator[L]:
        return (one for one in candidates if self._among is None or key(one) in self._among)

    def found(self, kinds: str) -> tuple[list[FittedModel], int]:
        """Laws, or terms, and of how many laws, or sets of signals, these are the best."""
        return self._laws if kinds == LAWS else self._terms

    @cached_property
    def _screen(self) -> CandidateScreening:
        return CandidateScreening(self._context, self._judge.cores)

    @cached_property
    def _laws(self) -> tuple[list[FittedModel], int]:
        several = len(self._context.samples.joints) > 1
        found = self._screen.laws(
            one for one in self._asked(library.laws(self._context)) if several or not one.confounded_with_gain
        )
        count = len({one.law.name for one in found}) or 1
        return self._fitted(_distinct(best_first(found), FITTED)), count

    @cached_property
    def _terms(self) -> tuple[list[FittedModel], int]:
        found = self._screen.terms(list(self._asked(library.terms(self._context))))
        best = _distinct(best_first(found), FITTED_TERMS)
        finer = self._side_by_side(lambda k: _refined(best[k], self._screen), len(best))
        best += [one for one in finer if one not in best]
        return self._fitted(best), len({key(one.law) for one in found})

    def _fitted(self, chosen: Sequence[ScreenedCandidate]) -> list[FittedModel]:
        first = self._accounts(lambda k: self._fit(chosen[k]), len(chosen))
        first.sort(key=lambda one: one.criterion)
        best, others = first[:SIMPLIFIED], first[SIMPLIFIED:]
        last = len(self._context.model.effects)
        return (
            self._accounts(
                lambda k: self._judge.share_across_joints(self._deeper(best[k]), last).model, len(best)
            )
            + others
        )

    def _deeper(self, account: FittedModel) -> FittedModel:
        """The account, from other delays where that is better: a term is screened at one pair of delays alone."""
        if not isinstance(account.last_effect.law, SignalTerm):
            return account
        other = FittedModel(fit_near_delays(account.model, self._judge.parts.fit), self._judge)
        return min(account, other, key=lambda one: one.criterion)

    def _accounts(self, work: Callable[[int], Model], count: int) -> list[FittedModel]:
        return [FittedModel(one, self._judge) for one in self._side_by_side(work, count)]

    def _side_by_side(self, work: Callable[[int], R], count: int) -> list[R]:
        return side_by_side(work, count, self._judge.cores, self._context.samples)

    def _fit(self, one: ScreenedCandidate) -> Model:
        """The candidate fitted on all joints, or on those that it acts on, whichever is better."""
        judge, model, law = self._judge, one.model, one.law
        near = model.with_delays(self._before.model.delays)
        if law.confounded_with_gain:
            # What all joints share is a gain's or a delay's.
            rows = judge.parts.fit
            model, near = (_without_weakest(fit(start, rows, 4, delays=False)) for start in (model, near))
        starts = [model, near] if law.shifts or law.confounded_with_gain else [model]
        every = min((judge.fit(start) for start in starts), key=lambda one: one.criterion)
        return judge.restrict_joints(every, len(every.model.effects) - 1).model


def _refined(one: ScreenedCandidate, screen: CandidateScreening) -> ScreenedCandidate:
    """A term with its place and time constants where it promises most."""
    for _ in range(3):
        assert isinstance(one.law, SignalTerm)
        near = library.refined(one.law)
        better = max(map(screen.term, near), key=lambda other: other.score, default=one)
        if better.score <= one.score:
            break
        one = better
    return one


def key(law: EffectLaw) -> tuple[str, ...]:
    """The name of a law, the signals of a term."""
    return law.inputs if isinstance(law, SignalTerm) else (law.name,)


def _distinct(found: Sequence[ScreenedCandidate], most: int) -> list[ScreenedCandidate]:
    """The first so many with different names, or signals, and of each name at most two forms."""
    chosen: list[ScreenedCandidate] = []
    for one in found:
        mine = key(one.law)
        if sum(key(other.law) == mine for other in chosen) < (1 if isinstance(one.law, SignalTerm) else 2):
            chosen.append(one)
        if len(chosen) == most:
            break
    return chosen


def _without_weakest(model: Model) -> Model:
    """The last effect off the joint where it is weakest, which gains or delays then stand for."""
    last = model.effects[-1]
    active: Bools = last.active & (np.arange(len(last.active)) != np.argmin(np.abs(last.values[0])))
    return model.with_replaced_effect(len(model.effects) - 1, attrs.evolve(last, active=active))
