"""Candidate effects on top of a model: screened, then the best ones fitted with everything else.

`screening` ranks candidates without fitting them; `selection` decides which one is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import cached_property
from typing import TypeVar

import attrs
import numpy as np

from quadvel_description.arrays import Bools

from ..model.effect_candidate import EffectCandidate
from ..model.fit import fit, fit_near_delays
from ..model.torque_model import Model
from ..parallel import parallel_map
from ..statistics.criterion import PENALTY_PER_PARAMETER
from . import regressor_library
from .context import Context
from .effect_candidates.registry import effect_candidates
from .fitted_model import RIVAL_FRACTION, TRIAL_ITERATIONS, FittedModel
from .regressors import RegressorCandidate
from .screening import CandidateScreening, ScreenedCandidate, promising

EFFECTS, REGRESSORS = "effects", "regressors"
Candidate = TypeVar("Candidate", bound=EffectCandidate)
Result = TypeVar("Result")


@attrs.frozen
class Fitted:
    """The best candidates of one kind.

    Attributes:
        models: Models with one of the candidates added.
        tested_count: Number of effects, or of sets of signals, that were screened, for the
            Bonferroni correction.
    """

    models: list[FittedModel]
    tested_count: int


class Candidates:
    """Fitted candidates on top of a model, best first."""

    def __init__(self, before: FittedModel, only: Collection[tuple[str, ...]] | None = None) -> None:
        """Prepare the candidates; the work is done on first use.

        Args:
            before: Model to extend.
            only: Keys of the candidates to consider; all if None.
        """
        evaluator = before.evaluator
        self._before, self._evaluator, self._only, self._options = before, evaluator, only, evaluator.options
        self._context = Context(before.model, evaluator.parts, evaluator.noise, evaluator.options)

    def _filtered(self, candidates: Iterable[Candidate]) -> Iterator[Candidate]:
        """The candidates to consider."""
        return (one for one in candidates if self._only is None or one.key in self._only)

    def fitted_candidates(self, kinds: str) -> Fitted:
        """Return the best candidates of one kind, fitted.

        Args:
            kinds: `EFFECTS` or `REGRESSORS`.

        Returns:
            Fitted models, and how many candidates were screened.
        """
        return self._effects if kinds == EFFECTS else self._regressors

    @cached_property
    def _screening(self) -> CandidateScreening:
        """Screening on top of the model."""
        return CandidateScreening(self._context, self._evaluator.cores)

    @cached_property
    def _effects(self) -> Fitted:
        """The best effects, fitted."""
        several = len(self._context.samples.joints) > 1
        present = {one.candidate.name for one in self._context.model.effects}
        found = self._screening.screen_effects(
            one
            for one in self._filtered(effect_candidates(self._context, present))
            if several or not one.confounded_with_gain
        )
        count = len({one.candidate.name for one in found}) or 1
        best = _first_distinct(promising(found), self._options.fitted_effects)
        return Fitted(self._fit_screened(best), count)

    @cached_property
    def _regressors(self) -> Fitted:
        """The best regressors, refined and fitted."""
        every = list(self._filtered(regressor_library.regressor_candidates(self._context)))
        found = self._screening.screen_regressors(every)
        best = _first_distinct(promising(found), self._options.fitted_regressors)
        if self._options.finer_regressors:
            finer = self._parallel_map(lambda k: _refine(best[k], self._screening), len(best))
            best += [one for one in finer if one not in best]
        return Fitted(self._fit_screened(best), len({one.key for one in every}))

    def _fit_screened(self, chosen: Sequence[ScreenedCandidate]) -> list[FittedModel]:
        """Fit the candidates: a few steps of each, then whole fits of the best one and its rivals."""
        begun = self._fit_parallel(lambda k: self._begin_fit(chosen[k]), len(chosen))
        begun.sort(key=lambda one: one.criterion)
        gains = [self._gain_on_needed_joints(one) for one in begun]
        rivals = [k for k, gain in enumerate(gains) if not k or gain > RIVAL_FRACTION * gains[0]]
        rivals = rivals[: self._options.finished_fits]
        finished = self._fit_parallel(lambda k: self._finish_fit(begun[rivals[k]]), len(rivals))
        return finished + [one for k, one in enumerate(begun) if k not in rivals]

    def _gain_on_needed_joints(self, fitted: FittedModel) -> float:
        """Reduction of the criterion by a candidate on the joints alone that it improves."""
        cost = PENALTY_PER_PARAMETER * fitted.last_effect.candidate.complexity(self._options.memory_cost)
        gain = self._before.log_errors - fitted.log_errors - cost
        return float(np.sum(np.maximum(gain, 0.0)))

    def _refit_near_delays(self, fitted: FittedModel) -> FittedModel:
        """Refit a regressor from nearby delays if that is better; its screening used one pair."""
        is_regressor = isinstance(fitted.last_effect.candidate, RegressorCandidate)
        if not (is_regressor and self._options.regressors_at_nearby_delays):
            return fitted
        other = FittedModel(fit_near_delays(fitted.model, self._evaluator.parts.fit), self._evaluator)
        return min(fitted, other, key=lambda one: one.criterion)

    def _fit_parallel(self, work: Callable[[int], Model], count: int) -> list[FittedModel]:
        """Fitted models of several tasks."""
        return [FittedModel(one, self._evaluator) for one in self._parallel_map(work, count)]

    def _parallel_map(self, work: Callable[[int], Result], count: int) -> list[Result]:
        return parallel_map(work, count, self._evaluator.cores, self._context.samples)

    def _begin_fit(self, screened: ScreenedCandidate) -> Model:
        """A few steps of the fit of a candidate, from the better one of its starts."""
        evaluator, model, candidate = self._evaluator, screened.model, screened.candidate
        if not self._options.second_starts:
            return evaluator.fit(model, TRIAL_ITERATIONS).model
        starts = [model]
        if candidate.confounded_with_delays:
            starts.append(model.with_delays(self._before.model.delays))
        if candidate.confounded_with_gain:
            # A value that all joints share is a change of a gain or a delay. One joint without the
            # effect makes the fit unique.
            rows = evaluator.parts.fit
            starts = [_drop_weakest_joint(fit(start, rows, 4, delays=False)) for start in starts]
        if len(starts) == 1:
            return evaluator.fit(starts[0], TRIAL_ITERATIONS).model
        begun = (evaluator.fit(start, TRIAL_ITERATIONS // 2) for start in starts)
        better = min(begun, key=lambda one: one.criterion)
        return evaluator.fit(better.model, TRIAL_ITERATIONS - TRIAL_ITERATIONS // 2).model

    def _finish_fit(self, begun: FittedModel) -> Model:
        """The whole fit of a candidate: on the joints that need it, with values that joints share."""
        evaluator, last = self._evaluator, len(self._context.model.effects)
        fitted = self._refit_near_delays(evaluator.restrict_joints(evaluator.fit(begun.model), last))
        return evaluator.share_across_joints(fitted, last).model


def _refine(screened: ScreenedCandidate, screening: CandidateScreening) -> ScreenedCandidate:
    """Hill climbing over the shape parameters of a regressor, by its screening score."""
    for _ in range(3):
        assert isinstance(screened.candidate, RegressorCandidate)
        near = regressor_library.refinements(screened.candidate)
        better = max(map(screening.screen_regressor, near), key=lambda other: other.score, default=screened)
        if better.score <= screened.score:
            break
        screened = better
    return screened


def _first_distinct(found: Sequence[ScreenedCandidate], most: int) -> list[ScreenedCandidate]:
    """The first `most` candidates, at most two of one effect and one of one set of signals."""
    chosen: list[ScreenedCandidate] = []
    for screened in found:
        key = screened.candidate.key
        if sum(other.candidate.key == key for other in chosen) < (
            1 if isinstance(screened.candidate, RegressorCandidate) else 2
        ):
            chosen.append(screened)
        if len(chosen) == most:
            break
    return chosen


def _drop_weakest_joint(model: Model) -> Model:
    """Remove the last effect from its weakest joint, where gain or delay stand for it."""
    last = model.effects[-1]
    active: Bools = last.active & (np.arange(len(last.active)) != np.argmin(np.abs(last.values[0])))
    return model.with_replaced_effect(len(model.effects) - 1, attrs.evolve(last, active=active))
