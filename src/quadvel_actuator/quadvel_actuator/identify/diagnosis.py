"""Which effects a log shows: one is added at a time while held-out rows say that it pays, and then pruned.

Every law of the registry is fitted on top of the model so far, together with gains and, where it looks like one, the
delays. The law with the least held-out error is taken; laws that predict as well within the noise are named with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs
import numpy as np

from ..effects import registry
from .candidates import About, Candidate, less_said, propose, started
from .delays import fit_with_delays, latest
from .few import Few, remembers
from .judging import Judge
from .model import Model
from .ranking import WORTH, Rejected, Tick, ranked
from .sharing import pooled, regroupings
from .signals import Array
from .valleys import deepest

LEVEL = 0.01
"""An effect is named if chance would bring its gain with less than this probability, all candidates counted."""

MOST = 5
"""Effects of one log at most."""

_BETTER_FORM = 0.99
"""of the held-out error, that another form of a law has to leave at most"""

_AS_WELL = 0.02
"""Of the noise: what an account with gains that can be believed may lose."""

_NEARLY, _MUCH = 0.7, 0.1
"""Of the best gain; and of the noise, what is much beside it"""
_FEW = 2
"""Effects that no other account needs to be looked for"""
BETTER_SAID = "terms of named signals say it better than the named laws together"
_TIE_LEVEL = 0.02
_TIE_SHARE = 0.03  # of the noise
_TIES = 3  # names beside the first one's
_SIMPLER_LOSES = 0.01  # of the noise


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


def diagnosed(
    model: Model, judge: Judge, noise: Array, tick: Tick, otherwise: Callable[[Model], bool], cores: int
) -> Diagnosis:
    """The effects on `model`; where its gains are far from those commanded, also with these held while effects are sought.

    What a joint swings freely can hide an inertia in lesser gains, and the other effects then come out bent. The account
    with the commanded gains is taken where it predicts as well; if they stray there, too, where it predicts better.
    Without measured torque the gains set the scale of all.
    """
    found = diagnose(model, judge, noise, tick, otherwise, cores)
    if model.implied or not model.samples.commanded or found.model.believable:
        return found
    other = diagnose(fit_with_delays(model.as_commanded(), judge.fit), judge, noise, tick, otherwise, cores)
    if not other.findings:
        return found
    tau = model.samples.tau
    lost = judge.compare(tau - other.model.predict(), tau - found.model.predict()).gain
    may_lose = _AS_WELL * float(noise.mean()) if other.model.believable else 0.0
    return other if lost < may_lose else found


def _released(model: Model, few: Few) -> Model:
    """With gains that are held left free, if they then stay near those commanded."""
    if not model.gains_held:
        return model
    free = few.fitted(attrs.evolve(model, gains_held=False), fit_with_delays, 10)
    return free if free.believable else model


def diagnose(
    model: Model, judge: Judge, noise: Array, tick: Tick, otherwise: Callable[[Model], bool], cores: int
) -> Diagnosis:
    """Add effects to `model` while it pays; `noise` (J,) is the floor of each joint, N^2 m^2.

    Several that still leave much, even with the next, are given up where `otherwise(model)` says that there is a better
    account without them.
    """
    bare = model
    given_up: list[Rejected] = []
    few = Few(model.samples, judge, (model.samples.tau - model.predict()) / np.sqrt(noise))
    ties: list[tuple[str, ...]] = []
    rejected: list[Rejected] = []
    for number in range(MOST + 1):
        model = model.holding(True)
        about = About(model, judge, noise, few)
        candidates, idle = ranked(about, tick, f"effect {number + 1}", cores)
        rejected = [*(_reason(one, noise, len(registry())) for one in candidates), *idle]
        finer = _finer(model, candidates, judge, noise, few)
        if finer is not None:
            model = finer
            continue
        more = bool(candidates) and _pays(candidates[0], noise, len(registry())) and number < MOST
        foreseen = candidates[0].model if more else model
        if len(model.applied) >= _FEW and _unsaid(foreseen, judge, noise) and otherwise(foreseen):
            return Diagnosis(bare, (), (*given_up, *rejected))
        if not more:
            break
        best, tied = _choice(_simpler_first(candidates, judge, noise, few), judge, noise)
        found = few.fitted(about.fit_anew(best.model.holding(False)), deepest, 1)
        found = fit_with_delays(found, judge.fit)
        found = _reformed(found, judge, few)
        model = _released(_widened(found, judge, noise, few), few)
        ties.append(tied)
        given_up.append(Rejected(best.name, best.gain, BETTER_SAID))
    model, ties = _pruned(attrs.evolve(model.holding(False), gains_held=False), ties, judge, noise, few)
    model, ties = _simplest(model, ties, judge, noise)
    model = _narrowed(model, judge, noise, few)
    model = pooled(model, judge, noise)
    if model.applied:
        model = _deepened(model, judge, few)
    findings = tuple(_finding(model, k, judge, tied, few) for k, tied in enumerate(ties))
    known = {one.name for one in findings} | {name for one in findings for name in one.indistinguishable}
    return Diagnosis(model, findings, tuple(one for one in rejected if one.name not in known))


def _unsaid(model: Model, judge: Judge, noise: Array) -> bool:
    """Is there much left beside the effects?"""
    return bool(model.mse(judge.judge) > (1.0 + _MUCH) * float(noise.mean()))


def _deepened(model: Model, judge: Judge, few: Few) -> Model:
    """The model at the bottom of its deepest valley; with a memory, as few rows show it, since all would take long."""
    if remembers(model):
        return fit_with_delays(few.fitted(model, deepest, 1), judge.fit)
    return deepest(model, judge.fit, 4)


def _reformed(model: Model, judge: Judge, few: Few) -> Model:
    """The model with those forms of its laws that suit each other best; the newest law came in the best of its own."""
    for index, one in enumerate(model.applied[:-1]):
        for form in one.law.forms:
            other = model.replacing(index, attrs.evolve(one, law=form))
            other = few.fitted(other, fit_with_delays, 10)
            if other.error(judge.judge) < _BETTER_FORM * model.error(judge.judge):
                model = other
    return model


def _pays(one: Candidate, noise: Array, tried: int) -> bool:
    return one.p * tried < LEVEL and bool(one.gain > 0.0) and _worth(one, noise) > WORTH


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


def _widened(model: Model, judge: Judge, noise: Array, few: Few) -> Model:
    """The model with each effect also on joints that show it only now, as what came later hid it there."""
    for k, one in enumerate(model.applied[:-1]):
        if one.active.all() or one.law.gainlike:
            continue
        usual = one.values[:, one.active].mean(axis=1, keepdims=True)
        everywhere = attrs.evolve(
            one, active=np.ones_like(one.active), values=np.where(one.active, one.values, usual)
        )
        tried = few.fitted(model.replacing(k, everywhere), fit_with_delays, 5)
        found = judge.compare(model.samples.tau - model.predict(), tried.samples.tau - tried.predict())
        clear = (found.p_joints * len(registry()) < LEVEL) & (found.joint_gain > WORTH * noise)
        if (clear & ~one.active).any():
            wider = attrs.evolve(tried.applied[k], active=one.active | clear)
            model = few.fitted(tried.replacing(k, wider), fit_with_delays, 5)
    return model


def _narrowed(model: Model, judge: Judge, noise: Array, few: Few) -> Model:
    """The model with each effect off joints that need it no more, the weakest ones first.

    What an effect bends before all of it is found, gains or delays of every joint, it can seem to mend on any of them.
    """
    for k in range(len(model.applied)):
        while model.applied[k].active.sum() > 1:
            one, given = model.applied[k], model.predict()
            share = np.mean(np.where(judge.fit, given - model.without(k).predict(), 0.0) ** 2, axis=0) / noise
            weakest = int(np.argmin(np.where(one.active, share, np.inf)))
            fewer = attrs.evolve(one, active=one.active & (np.arange(len(noise)) != weakest))
            tried = few.fitted(model.replacing(k, fewer), fit_with_delays, 10)
            lost = judge.compare(tried.samples.tau - tried.predict(), model.samples.tau - given)
            if lost.p_any * len(registry()) < LEVEL and lost.gain > WORTH * noise[weakest] / len(noise):
                break
            model = tried
    return model


def _worth(one: Candidate, noise: Array) -> float:
    """Gain as a share of the noise, on the joints that it acts on or on all, as it can set free what they share."""
    on = one.joints
    return float(max(one.joint_gain[on].sum() / noise[on].sum(), one.joint_gain.sum() / noise.sum()))


def _reason(one: Candidate, noise: Array, tried: int) -> Rejected:
    if one.p * tried >= LEVEL:
        reason = (
            f"not significant on held-out data (p = {min(one.p * tried, 1.0):.2g} after {tried} candidates)"
        )
    elif _worth(one, noise) <= WORTH:
        reason = f"worth {100 * _worth(one, noise):.1f} % of the noise floor, below {100 * WORTH:.0f} %"
    else:
        reason = "nothing left for it once the named effects are in"
    return Rejected(one.name, one.gain, reason)


def _choice(candidates: Sequence[Candidate], judge: Judge, noise: Array) -> tuple[Candidate, tuple[str, ...]]:
    """The best candidate, or the simplest one that predicts as well; and the names of the others that do."""
    best = candidates[0]
    equal = [best, *(one for one in candidates[1:] if _ties(best, one, judge, noise))]
    size = {one.name: len(one.law.parameters) for one in equal}
    chosen = best
    for one in equal[1:]:
        if size[one.name] < size[chosen.name] and best.gain - one.gain < _SIMPLER_LOSES * float(noise.mean()):
            chosen = one
    return chosen, tuple(one.name for one in equal if one is not chosen)[:_TIES]


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


def _ties(best: Candidate, other: Candidate, judge: Judge, noise: Array) -> bool:
    """Is the other's held-out error the same within the noise?"""
    if other.gain <= 0.5 * best.gain:
        return False
    found = judge.compare(other.residual, best.residual)
    return found.gain < 0.005 * float(noise.mean()) or (
        found.p_any > _TIE_LEVEL and found.gain < _TIE_SHARE * float(noise.mean())
    )


def _pruned(
    model: Model, ties: list[tuple[str, ...]], judge: Judge, noise: Array, few: Few
) -> tuple[Model, list[tuple[str, ...]]]:
    """Without the effects that the later ones made needless, and fitted once more with the delays."""
    while model.applied:
        losses = [_loss(model, k, judge, few) for k in range(len(model.applied))]
        worst = int(np.argmin([loss for loss, _, _ in losses]))
        loss, p, less = losses[worst]
        active = model.applied[worst].active
        if p * len(registry()) < LEVEL and loss > WORTH * float(noise[active].mean()) * float(active.mean()):
            break
        model = less
        ties = [tied for k, tied in enumerate(ties) if k != worst]
    return (fit_with_delays(model, judge.fit) if model.applied else model), ties


def _simplest(
    model: Model, ties: list[tuple[str, ...]], judge: Judge, noise: Array
) -> tuple[Model, list[tuple[str, ...]]]:
    """With simpler laws where these say as much: what came later may have been why the other law was needed."""
    ties = list(ties)
    for k, one in enumerate(model.applied):
        less = less_said(one)
        if less is None or any(other.law.name == less.law.name for other in model.applied):
            continue
        tried = fit_with_delays(model.replacing(k, less), judge.fit)
        lost = judge.compare(tried.samples.tau - tried.predict(), model.samples.tau - model.predict())
        if lost.gain < _SIMPLER_LOSES * float(noise.mean()):
            model = tried
            ties[k] = (one.law.name, *(name for name in ties[k] if name != less.law.name))[:_TIES]
    return model, ties


def _loss(model: Model, index: int, judge: Judge, few: Few) -> tuple[float, float, Model]:
    """What leaving an effect out costs on held-out rows, its p-value, and the model without it."""
    less = few.fitted(model.without(index), fit_with_delays, 5)
    found = judge.compare(less.samples.tau - less.predict(), model.samples.tau - model.predict())
    return found.gain, found.p_any, less


def _finding(model: Model, index: int, judge: Judge, tied: tuple[str, ...], few: Few) -> Finding:
    gain, p, _ = _loss(model, index, judge, few)
    return Finding(model.applied[index].law.name, gain, p, tied)
