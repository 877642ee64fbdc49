"""Candidate effects on top of a model: screened, then the best ones fitted with everything else."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import cached_property
from typing import TypeVar

import attrs
import numpy as np

from quadvel_actuator.effects import EffectLaw
from quadvel_description.arrays import Bools

from ..model.fit import fit, fit_near_delays
from ..model.torque_model import Model
from ..parallel import parallel_map
from . import library
from .fitted_model import FittedModel
from .library import Context, SignalTerm
from .screening import CandidateScreening, ScreenedCandidate, promising

LAWS, TERMS = "laws", "terms"
Law = TypeVar("Law", bound=EffectLaw)
Result = TypeVar("Result")


class Candidates:
    """Fitted candidates on top of a model, best first."""

    def __init__(self, before: FittedModel, only: Collection[tuple[str, ...]] | None = None) -> None:
        """Prepare the candidates; the work is done on first use.

        Args:
            before: Model to extend.
            only: Keys (`candidate_key`) of the candidates to consider; all if None.
        """
        evaluator = before.evaluator
        self._before, self._evaluator, self._only, self._devices = before, evaluator, only, evaluator.devices
        self._context = Context(before.model, evaluator.parts, evaluator.noise, evaluator.devices)

    def _filtered(self, candidates: Iterable[Law]) -> Iterator[Law]:
        """The candidates to consider."""
        return (one for one in candidates if self._only is None or candidate_key(one) in self._only)

    def fitted_candidates(self, kinds: str) -> tuple[list[FittedModel], int]:
        """Return the best candidates of one kind, fitted.

        Args:
            kinds: `LAWS` or `TERMS`.

        Returns:
            Fitted models, and the number of laws or of sets of signals that were screened, which
            the Bonferroni correction uses.
        """
        return self._laws if kinds == LAWS else self._terms

    @cached_property
    def _screening(self) -> CandidateScreening:
        """Screening on top of the model."""
        return CandidateScreening(self._context, self._evaluator.cores)

    @cached_property
    def _laws(self) -> tuple[list[FittedModel], int]:
        """The best laws, fitted, and the number of screened laws."""
        several = len(self._context.samples.joints) > 1
        found = self._screening.screen_laws(
            one
            for one in self._filtered(library.law_candidates(self._context))
            if several or not one.confounded_with_gain
        )
        count = len({one.law.name for one in found}) or 1
        return self._fit_screened(_first_distinct(promising(found), self._devices.fitted_laws)), count

    @cached_property
    def _terms(self) -> tuple[list[FittedModel], int]:
        """The best regressors, refined and fitted, and the number of screened sets of signals."""
        found = self._screening.screen_terms(list(self._filtered(library.term_candidates(self._context))))
        best = _first_distinct(promising(found), self._devices.fitted_terms)
        if self._devices.finer_terms:
            finer = self._parallel_map(lambda k: _refine_term(best[k], self._screening), len(best))
            best += [one for one in finer if one not in best]
        return self._fit_screened(best), len({candidate_key(one.law) for one in found})

    def _fit_screened(self, chosen: Sequence[ScreenedCandidate]) -> list[FittedModel]:
        """Fit the candidates, and share the values of the best ones across joints."""
        fitted = self._fit_parallel(lambda k: self._fit_candidate(chosen[k]), len(chosen))
        fitted.sort(key=lambda one: one.criterion)
        tried = self._devices.shared_trials
        best, others = fitted[:tried], fitted[tried:]
        last = len(self._context.model.effects)
        return (
            self._fit_parallel(
                lambda k: self._evaluator.share_across_joints(self._refit_near_delays(best[k]), last).model,
                len(best),
            )
            + others
        )

    def _refit_near_delays(self, fitted: FittedModel) -> FittedModel:
        """Refit a regressor from nearby delays if that is better; its screening used one pair."""
        if not (self._devices.terms_at_nearby_delays and isinstance(fitted.last_effect.law, SignalTerm)):
            return fitted
        other = FittedModel(fit_near_delays(fitted.model, self._evaluator.parts.fit), self._evaluator)
        return min(fitted, other, key=lambda one: one.criterion)

    def _fit_parallel(self, work: Callable[[int], Model], count: int) -> list[FittedModel]:
        """Fitted models of several tasks."""
        return [FittedModel(one, self._evaluator) for one in self._parallel_map(work, count)]

    def _parallel_map(self, work: Callable[[int], Result], count: int) -> list[Result]:
        return parallel_map(work, count, self._evaluator.cores, self._context.samples)

    def _fit_candidate(self, candidate: ScreenedCandidate) -> Model:
        """Fit a candidate on all joints, and on those where it is significant if that is better."""
        evaluator, model, law = self._evaluator, candidate.model, candidate.law
        near, last = model.with_delays(self._before.model.delays), len(model.effects) - 1
        if not self._devices.second_starts:
            return evaluator.restrict_joints(evaluator.fit(model), last).model
        if law.confounded_with_gain:
            # A value that all joints share is a change of a gain or a delay. One joint without the
            # effect makes the fit unique.
            rows = evaluator.parts.fit
            model, near = (_drop_weakest_joint(fit(start, rows, 4, delays=False)) for start in (model, near))
        starts = [model, near] if law.shifts or law.confounded_with_gain else [model]
        fitted = min((evaluator.fit(start) for start in starts), key=lambda one: one.criterion)
        return evaluator.restrict_joints(fitted, last).model


def _refine_term(candidate: ScreenedCandidate, screening: CandidateScreening) -> ScreenedCandidate:
    """Hill climbing over the shape parameters of a regressor, by its screening score."""
    for _ in range(3):
        assert isinstance(candidate.law, SignalTerm)
        near = library.refinements(candidate.law)
        better = max(map(screening.screen_term, near), key=lambda other: other.score, default=candidate)
        if better.score <= candidate.score:
            break
        candidate = better
    return candidate


def candidate_key(law: EffectLaw) -> tuple[str, ...]:
    """Return the key by which candidates count as the same.

    Args:
        law: A law or a regressor of named signals.

    Returns:
        The name of a law; the input signals of a regressor.
    """
    return law.input_signals if isinstance(law, SignalTerm) else (law.name,)


def _first_distinct(found: Sequence[ScreenedCandidate], most: int) -> list[ScreenedCandidate]:
    """The first `most` candidates, at most two of one law and one of one set of signals."""
    chosen: list[ScreenedCandidate] = []
    for candidate in found:
        key = candidate_key(candidate.law)
        if sum(candidate_key(other.law) == key for other in chosen) < (
            1 if isinstance(candidate.law, SignalTerm) else 2
        ):
            chosen.append(candidate)
        if len(chosen) == most:
            break
    return chosen


def _drop_weakest_joint(model: Model) -> Model:
    """Remove the last effect from its weakest joint, where gain or delay stand for it."""
    last = model.effects[-1]
    active: Bools = last.active & (np.arange(len(last.active)) != np.argmin(np.abs(last.values[0])))
    return model.with_replaced_effect(len(model.effects) - 1, attrs.evolve(last, active=active))
