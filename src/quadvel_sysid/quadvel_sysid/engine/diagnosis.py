"""Which effects a log shows: one is added at a time while held-out rows say that it pays, and put right beside the others.

Every law of the registry is fitted on top of the model so far, together with gains and, where it looks like one, the
delays. The law with the least held-out error is taken; laws that predict as well within the noise are named with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs
import numpy as np

from quadvel_actuator.effects import registry

from .candidates import About, Candidate, propose, started
from .company import Company, Said, with_kin
from .delays import fit_with_delays, latest
from .few import Few
from .judging import Judge
from .model import Model
from .ranking import LEVEL, WORTH, Rejected, Tick, choice, ranked, worth
from .sharing import pooled, regroupings
from .signals import Array

MOST = 5
"""Effects of one log at most."""

_AS_WELL = 0.02
"""Of the noise: what an account with gains that can be believed may lose."""

_NEARLY, _MUCH = 0.7, 0.1
"""Of the best gain; and of the noise, what is much beside it"""
Otherwise = Callable[[Model, Model], Model | None]
"""From effects, and those without the last one, to the model beside terms that say more; None where they do not"""
BETTER_SAID = "terms of named signals say it better than the named laws together"


@attrs.frozen(eq=False)
class Finding:
    """An effect that stayed: applied[index] of the model."""

    name: str
    gain: float  # held-out error without it less that with it, N^2 m^2
    p: float
    indistinguishable: tuple[str, ...] = ()


@attrs.frozen(eq=False)
class Diagnosis:
    """The corrected model, its effects in the order of model.applied, and the laws that were turned down."""

    model: Model
    findings: tuple[Finding, ...]
    rejected: tuple[Rejected, ...]
    instead: Model | None = None
    """beside the terms that were preferred to all effects, if they were"""


def diagnosed(
    model: Model, judge: Judge, noise: Array, tick: Tick, otherwise: Otherwise, cores: int
) -> Diagnosis:
    """The effects on `model`; where its gains are far from those commanded, also with these held while effects are sought.

    What a joint swings freely can hide an inertia in lesser gains, and the other effects then come out bent. The account
    with the commanded gains is taken where it predicts as well; if they stray there, too, where it predicts better.
    Without measured torque the gains set the scale of all.
    """
    found = diagnose(model, judge, noise, tick, otherwise, cores)
    if model.implied or not model.samples.commanded or (found.instead or found.model).believable:
        return found
    other = diagnose(fit_with_delays(model.as_commanded(), judge.fit), judge, noise, tick, otherwise, cores)
    if not other.findings:
        return found
    tau = model.samples.tau
    lost = judge.compare(tau - other.model.predict(), tau - found.model.predict()).gain
    may_lose = _AS_WELL * float(noise.mean()) if other.model.believable else 0.0
    return other if lost < may_lose else found


def diagnose(
    model: Model, judge: Judge, noise: Array, tick: Tick, otherwise: Otherwise, cores: int
) -> Diagnosis:
    """Add effects to `model` while it pays; `noise` (J,) is the floor of each joint, N^2 m^2.

    Several that still leave much, even with the next, are given up where `otherwise` knows of a better account without them.
    """
    bare = model
    given_up: list[Rejected] = []
    few = Few(model.samples, judge, (model.samples.tau - model.predict()) / np.sqrt(noise))
    company = Company(judge, noise, few, cores)
    said: list[Said] = []
    rejected: list[Rejected] = []
    while True:
        model = model.holding(True)
        about = About(model, judge, noise, few, cores)
        candidates, idle = ranked(about, tick, f"effect {len(said) + 1}")
        rejected = [*(_reason(one, noise, len(registry())) for one in candidates), *idle]
        finer = _finer(model, candidates, judge, noise, few)
        if finer is not None:
            model = finer
            continue
        more = bool(candidates) and _pays(candidates[0], noise, len(registry())) and len(said) < MOST
        if more:
            best, ties = choice(_simpler_first(candidates, judge, noise, few), judge, noise)
            model, before = company.exchanged(company.taken(about, best), said)
        if said and _unsaid(model, judge, noise):
            instead = otherwise(model, about.model)
            if instead is not None:
                return Diagnosis(bare, (), (*given_up, *rejected), instead)
        if not more:
            break
        near = tuple(one.name for one in candidates if one.gain > _NEARLY * candidates[0].gain)
        given_up.append(Rejected(best.name, best.gain, BETTER_SAID))
        said = [*before, Said(ties, near)]
    model, said = company.pruned(attrs.evolve(model.holding(False), gains_held=False), said)
    model, said = company.pruned(*company.exchanged(model, with_kin(model, said)))
    model, said = company.simplest(model, said)
    model = pooled(company.narrowed(model), judge, noise)
    if model.applied:
        model = company.deepened(model)
    there = len(model.applied)
    model, said, losses = company.needed(model, said)
    if 0 < len(model.applied) < there:
        model = company.deepened(model)
    findings = tuple(
        Finding(one.law.name, loss.gain, loss.p_any, of_it.ties)
        for one, loss, of_it in zip(model.applied, losses, said, strict=True)
    )
    known = {one.name for one in findings} | {name for one in findings for name in one.indistinguishable}
    return Diagnosis(model, findings, tuple(one for one in rejected if one.name not in known))


def _unsaid(model: Model, judge: Judge, noise: Array) -> bool:
    """Is there much left beside the effects?"""
    return bool(model.mse(judge.judge) > (1.0 + _MUCH) * float(noise.mean()))


def _pays(one: Candidate, noise: Array, tried: int) -> bool:
    return one.p * tried < LEVEL and bool(one.gain > 0.0) and worth(one.joint_gain, one.joints, noise) > WORTH


def _finer(
    model: Model, candidates: Sequence[Candidate], judge: Judge, noise: Array, few: Few
) -> Model | None:
    """The model with gains or delays shared by fewer joints, if that pays more than any effect does."""
    best = candidates[0].gain if candidates and _pays(candidates[0], noise, len(registry())) else 0.0
    chosen, most = None, max(best, WORTH * float(noise.mean()))
    left = model.samples.tau - latest(model, judge.fit).predict()
    for _, tried in regroupings(model, few):
        found = judge.compare(left, tried.samples.tau - latest(tried, judge.fit).predict())
        if found.gain > most and found.p_any * len(registry()) < LEVEL:
            chosen, most = tried, found.gain + 0.5 * WORTH * float(noise.mean())
    return chosen


def _reason(one: Candidate, noise: Array, tried: int) -> Rejected:
    if one.p * tried >= LEVEL:
        reason = (
            f"not significant on held-out data (p = {min(one.p * tried, 1.0):.2g} after {tried} candidates)"
        )
    elif (share := worth(one.joint_gain, one.joints, noise)) <= WORTH:
        reason = f"worth {100 * share:.1f} % of the noise floor, below {100 * WORTH:.0f} %"
    else:
        reason = "nothing left for it once the named effects are in"
    return Rejected(one.name, one.gain, reason)


def _simpler_first(
    candidates: Sequence[Candidate], judge: Judge, noise: Array, few: Few
) -> Sequence[Candidate]:
    """The candidates, a simpler law first that is nearly as good as the best one and with that on top says more than it.

    The best one alone may owe its place to parameters that stand for both, and it would not find its own again.
    """
    best = candidates[0]
    few_words = len(best.law.parameters)
    simpler = [
        one for one in candidates if len(one.law.parameters) < few_words and one.gain > _NEARLY * best.gain
    ]
    if not simpler or not _unsaid(best.model, judge, noise):
        return candidates
    first = simpler[0]
    beside = About(first.model, judge, noise, few)
    start = started(beside, best.law)
    both = None if start is None else propose(beside, start)
    if both is None or judge.compare(best.residual, both.residual).gain < WORTH * float(noise.mean()):
        return candidates
    return [first]
