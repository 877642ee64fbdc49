"""The laws of the registry, held against each other on top of a model: which takes most off the held-out error?

What a law promises is found by least squares at many starts; those that promise enough are fitted, with gains and delays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs
import numpy as np

from quadvel_actuator.effects import EffectLaw, registry

from .ahead import Ahead, R
from .candidates import About, Candidate, anew, propose, simplified, started
from .judging import Judge
from .screening import Started
from .signals import Array, Bools

WORTH = 0.03
"""Least gain of an effect, as a share of the noise: see `worth`."""

LEVEL = 0.01
"""An effect is named if chance would bring its gain with less than this probability, all candidates counted."""

_FITTED = 5
_PROMISING, _LITTLE = 0.5, 0.1
"""A law is fitted further that is among the first few and quick, or that promises so much of what the best one so far
keeps of its promise and so much of what is above the noise; of the best promise, where nothing much is above it. One that
looks like a delay always is, in one of its forms at least: what it promises is for delays that are not its own."""
_STUCK, _AGAIN = 0.7, 2
"""Of its promise: what keeps less was fitted from delays that are not its own; and so many are fitted from others"""
_LEAD, _NEAR = 3, 0.8
"""So many in the lead, and so near the best one's gain"""
SIMPLER_LOSES = 0.01
"""Of the noise: what a simpler law may lose"""
TIES = 3
"""Names beside the first one's"""
_TIE_LEVEL, _TIE_SHARE = 0.02, 0.03  # of the noise
Tick = Callable[[str], None]


@attrs.frozen(eq=False)
class Rejected:
    """A law that was turned down, and why."""

    name: str
    gain: float
    reason: str


def ranked(about: About, tick: Tick, what: str) -> tuple[list[Candidate], list[Rejected]]:
    """Every law of the registry on top of the model, the best form of each, least held-out error first.

    Second, those that do not come into question.
    """
    race = _Race(about)
    looked = race.looked(lambda name: tick(f"{what}: {name}"))
    race.fit(looked, lambda name: tick(f"{what}: {name}, fitted"))
    race.fit_stuck_ones_again()
    race.try_simpler()
    out = [one for name, one in race.idle.items() if name not in race.best]
    return race.settled(), out


class _Race:
    """The best candidate of each law so far."""

    def __init__(self, about: About) -> None:
        self.about = about
        self.taken = {one.law.name for one in about.model.applied}
        self.best: dict[str, Candidate] = {}
        self.idle: dict[str, Rejected] = {}
        self._stuck: list[tuple[float, Candidate]] = []  # with what they promised
        self._again: set[str] = set()  # laws that were fitted from other delays already

    def looked(self, tick: Tick) -> list[Started]:
        """Where to fit each form of each law from, the most promising first."""
        forms: list[EffectLaw] = []
        for name, law in registry().items():
            if name not in self.taken:
                reason = "takes nothing off the error of the fitted data"
                self.idle[name] = Rejected(name, 0.0, reason)
                forms += law.variants(self.about)
        found: list[Started] = []
        with self._ahead(lambda k: started(self.about, forms[k])) as ahead:
            for k, form in enumerate(forms):
                tick(form.name)
                one = ahead.take(k, range(k + 1, len(forms)))
                found += [one] if one is not None else []
        return sorted(found, key=lambda one: -one.promise)

    def fit(self, looked: list[Started], tick: Tick) -> None:
        """All that are quick to fit, or promise enough."""
        least, firsts = self._least_promise(looked), _firsts([one.law for one in looked])

        def counts(k: int) -> bool:
            law = looked[k].law
            quick = k < _FITTED and not law.remembers
            return quick or looked[k].promise >= least or (law.shifts and k in firsts)

        with self._ahead(lambda k: propose(self.about, looked[k])) as ahead:
            for k, first in enumerate(looked):
                name = first.law.name
                if not counts(k):
                    reason = "takes far less off the error of the fitted data than others do"
                    self.idle[name] = Rejected(name, 0.0, reason)
                    continue
                tick(name)
                found = ahead.take(k, filter(counts, range(k + 1, len(looked))))
                if found is None:
                    continue
                self._take(found)
                if found.law.foretold() is found.law:
                    kept = self.about.kept(found)
                    least = max(least, _PROMISING * kept)
                    if kept < _STUCK * first.promise:
                        self._stuck.append((first.promise, found))

    def _ahead(self, work: Callable[[int], R]) -> Ahead[R]:
        return Ahead(work, self.about.cores, self.about.samples)

    def _least_promise(self, looked: list[Started]) -> float:
        rows = self.about.few.fitted_rows
        above = float(np.maximum(self.about.left - rows, 0.0).sum())
        if above >= _LITTLE * rows.sum():
            return _LITTLE * above
        return _PROMISING * max((one.promise for one in looked if one.law.foretold() is one.law), default=0.0)

    def fit_stuck_ones_again(self) -> None:
        """Those that keep far less than they promise while no other keeps as much, from other delays."""
        for promise, one in self._stuck[:_AGAIN]:
            most = max(self.about.kept(other) for other in self.best.values())
            if promise > max(WORTH * self.about.few.fitted_rows.sum(), most):
                self._take(anew(self.about, one))
                self._again.add(one.name)

    def try_simpler(self) -> None:
        """The simpler law that the best one can become."""
        leader = max(self.best.values(), key=lambda one: one.gain, default=None)
        less = None if leader is None else simplified(self.about, leader)
        if less is not None and less.name not in self.taken:
            self._take(less)

    def settled(self) -> list[Candidate]:
        """The best ones, least error first; those in the lead fitted from other delays, too, if one looks like a delay.

        What they change and what the delays stand for goes together, and each can be stuck at delays that are not its own.
        """
        order = self._in_order()
        most = order[0].gain if order else 0.0
        lead = [one for one in order[:_LEAD] if one.gain > _NEAR * most]
        open_race = len(lead) > 1 and any(one.law.shifts for one in lead)
        if open_race and most > WORTH * float(self.about.noise.mean()):
            for one in lead:
                if one.name not in self._again:
                    self._take(anew(self.about, one))
        return self._in_order()

    def _in_order(self) -> list[Candidate]:
        return sorted(self.best.values(), key=lambda one: -one.gain)

    def _take(self, one: Candidate) -> None:
        if one.name not in self.best or one.gain > self.best[one.name].gain:
            self.best[one.name] = one


def _firsts(laws: Sequence[EffectLaw]) -> set[int]:
    """Indices of the laws that are no other form of one before them: that one can still take it on."""
    met: set[tuple[str, str]] = set()
    firsts = set()
    for k, law in enumerate(laws):
        if (law.name, str(law.settings)) not in met:
            firsts.add(k)
        met |= {(form.name, str(form.settings)) for form in law.forms}
    return firsts


def worth(joint_gain: Array, on: Bools, noise: Array) -> float:
    """Gain (J,) as a share of the noise: on the joint that shows an effect best, or on all, as it can set free what they share.

    What a law says of a joint is held against what a term would say of it; how little others show it is no matter.
    """
    return float(max((joint_gain / noise)[on].max(), joint_gain.sum() / noise.sum()))


def choice(candidates: Sequence[Candidate], judge: Judge, noise: Array) -> tuple[Candidate, tuple[str, ...]]:
    """The best candidate, or the simplest one that predicts as well; and the names of the others that do."""
    best = candidates[0]
    equal = [best, *(one for one in candidates[1:] if _ties(best, one, judge, noise))]
    size = {one.name: len(one.law.parameters) for one in equal}
    chosen = best
    for one in equal[1:]:
        if size[one.name] < size[chosen.name] and best.gain - one.gain < SIMPLER_LOSES * float(noise.mean()):
            chosen = one
    return chosen, tuple(one.name for one in equal if one is not chosen)[:TIES]


def _ties(best: Candidate, other: Candidate, judge: Judge, noise: Array) -> bool:
    """Is the other's held-out error the same within the noise?"""
    if other.gain <= 0.5 * best.gain:
        return False
    found = judge.compare(other.residual, best.residual)
    return found.gain < SIMPLER_LOSES * float(noise.mean()) or (
        found.p_any > _TIE_LEVEL and found.gain < _TIE_SHARE * float(noise.mean())
    )
