"""The simplest account of a log: named effects, terms of named signals, or both.

An effect that the registry does not hold is often caught in part by several laws of it, and what they leave then names
the wrong signals. So terms are also tried without any law, and held-out rows decide; of equals the shorter account stays.
"""

from __future__ import annotations

import attrs
import numpy as np

from .as_sent import as_sent
from .diagnosis import BETTER_SAID, Diagnosis
from .few import Few
from .intervals import on_bound
from .judging import Judge
from .learned import LEVEL, Learned, a_joint, learn
from .model import Model
from .picks import WORTH
from .ranking import Rejected
from .signals import Array

_AT_FLOOR = 1.05
"""Of the noise: laws that leave no more than this need no other account."""

_MOST = 0.8
"""Of what is above the noise: a law that takes so much is the account, whatever is left beside it."""

_OF_TWO, _OF_MORE = 0.25, 0.5
"""Of what two laws leave above the noise, to which a third may come, and of what more do: what terms may leave"""

_TWO = 2
"""Laws that may be a part of those there are, whatever they leave"""

_HOPELESS, _LITTLE_MORE = 0.1, 1.0 / 3.0
"""Of what laws leave above the noise: what terms may leave, in any number of words, where the last law took so little off it"""

_AS_WELL = 0.02
"""Of the noise: what a shorter account may lose."""

_LITTLE = 0.03
"""Of what terms take off the error: terms that say less may take so much less."""

_TERM = 2
"""A term of signals says as much as so many laws."""

_SHAPED = "q"
"""The signal whose laws add up to any shape; those of dq, friction and drag, go together by nature."""


class Alone:
    """Terms of named signals on `before`, the model without effects: what they say without any law."""

    def __init__(self, before: Model, judge: Judge, noise: Array, cores: int = 1) -> None:
        """`cores` share the work."""
        self.before, self._judge, self._noise, self.cores = before, judge, noise, cores
        self._found: dict[float, Learned | None] = {}  # by how many terms a joint were enough

    @property
    def learned(self) -> Learned | None:
        """From the gains as they were fitted, or from those commanded, if that leaves much or they stray far."""
        return self._in_few(np.inf)

    def _in_few(self, enough: float) -> Learned | None:
        """The same, if so many terms a joint are enough; else some of them, but more than that."""
        if np.inf in self._found:
            enough = np.inf
        if enough not in self._found:
            self._found[enough] = self._learned(enough)
        return self._found[enough]

    def _learned(self, enough: float) -> Learned | None:
        before, judge, noise = self.before, self._judge, self._noise
        found = learn(before, judge, noise, self.cores, enough)
        model = before if found is None else found.model
        if before.implied or not before.samples.commanded:
            return found
        if model.believable and self._at_floor(model, found):
            return found
        few = Few(before.samples, judge, (before.samples.tau - before.predict()) / np.sqrt(noise))
        other = learn(as_sent(before, few), judge, noise, self.cores, enough)
        if other is None or other.model.gains_held:  # left free, they stray: nothing can be said of them
            return found
        if found is None:
            gain = self._above(before, None) - self._above(other.model, other)
            return other if gain > WORTH * _floor(judge, noise) else None
        return self._better(found, other)

    def _better(self, one: Learned, other: Learned) -> Learned:
        """Of those whose gains can be believed, if there are any, the shorter one, or the better one where it says more."""
        believable = [terms for terms in (one, other) if terms.model.believable] or [one, other]
        left = {id(terms): self._above(terms.model, terms) for terms in believable}
        most = self._above(self.before, None) - min(left.values())
        good = [terms for terms in believable if left[id(terms)] - min(left.values()) < _LITTLE * most]
        return min(good, key=lambda terms: (_words(None, terms), left[id(terms)]))

    def says_more(self, laws: Model, before: Model) -> Model | None:
        """The model beside terms that say more than `laws`, which were `before` the last one came; None if they do not.

        Terms of no more words leave no more than the noise, or far less than the laws do; of more words next to nothing
        beside what the laws leave, while these grow in number and come no nearer.
        """
        with_laws, words = self._above(laws, None), _words(laws, None)
        growing = len(laws.applied) > max(len(before.applied), _TWO)
        nearer = with_laws < (1.0 - _LITTLE_MORE) * self._above(before, None)
        hopeless = growing and not nearer
        terms = self.learned if hopeless else self._in_few(words / _TERM)
        if terms is None:
            return None
        with_terms = self._above(terms.model, terms)
        if _words(None, terms) > words:
            return terms.model if hopeless and with_terms < _HOPELESS * with_laws else None
        share = _OF_TWO if len(laws.applied) == _TWO else _OF_MORE
        more = with_terms < share * with_laws or self._at_floor(terms.model, terms)
        return terms.model if more else None

    def _at_floor(self, model: Model, terms: Learned | None) -> bool:
        return self._above(model, terms) < (_AT_FLOOR - 1.0) * _floor(self._judge, self._noise)

    def _above(self, model: Model, terms: Learned | None) -> float:
        """What they leave above the noise, N^2 m^2."""
        left = _left(model, terms)
        return self._judge.compare(left, np.zeros_like(left)).gain - _floor(self._judge, self._noise)


def account(
    alone: Alone, diagnosis: Diagnosis, judge: Judge, noise: Array
) -> tuple[Diagnosis, Learned | None]:
    """The diagnosis with the terms that it needs beside it, or terms instead of it.

    The diagnosis that comes back holds the model fitted beside the terms.
    """
    unsaid = diagnosis.model is alone.before
    beside = alone.learned if unsaid else learn(diagnosis.model, judge, noise, alone.cores)
    floor = _floor(judge, noise)
    named = _with(diagnosis, beside)
    if not diagnosis.findings or _enough(alone.before, diagnosis, beside, judge, floor):
        return named, beside
    if _one_shape(diagnosis):  # what hid the delays is found then
        terms = learn(attrs.evolve(diagnosis.model, applied=()), judge, noise, alone.cores)
    else:
        terms = alone.learned
    if terms is None or not _shorter_or_better(named, beside, terms, judge, floor):
        return named, beside
    given_up = tuple(Rejected(one.name, one.gain, BETTER_SAID) for one in diagnosis.findings)
    return Diagnosis(terms.model, (), (*given_up, *diagnosis.rejected)), terms


def _floor(judge: Judge, noise: Array) -> float:
    return float(np.average(noise, weights=np.maximum(judge.judge.sum(axis=0), 1)))


def _enough(before: Model, diagnosis: Diagnosis, beside: Learned | None, judge: Judge, floor: float) -> bool:
    """Do the laws say nearly everything, and more than that there is a shape?"""
    if _one_shape(diagnosis):
        return False
    left = diagnosis.model.mse(judge.judge)
    if len(diagnosis.findings) == 1 and left - floor < (1.0 - _MOST) * (before.mse(judge.judge) - floor):
        return True
    return beside is None and left < _AT_FLOOR * floor


def _one_shape(diagnosis: Diagnosis) -> bool:
    """Are they several laws of the angle alone? A spring and cogging together can look like a stop or any other shape."""
    laws = [one.law for one in diagnosis.model.applied]
    return len(laws) > 1 and all(law.signal == _SHAPED for law in laws)


def _with(diagnosis: Diagnosis, learned: Learned | None) -> Diagnosis:
    return diagnosis if learned is None else attrs.evolve(diagnosis, model=learned.model)


def _left(model: Model, learned: Learned | None) -> Array:
    left: Array = model.samples.tau - model.predict()
    return left if learned is None else left - learned.torque


def _shorter_or_better(
    named: Diagnosis, beside: Learned | None, alone: Learned, judge: Judge, floor: float
) -> bool:
    found = judge.compare(_left(named.model, beside), _left(alone.model, alone))
    if found.gain > WORTH * floor and found.p_any < LEVEL:
        return True
    if _one_shape(named) and alone.inputs[0] == _SHAPED:
        # A law that sits on its bound is another one.
        may_lose = _AS_WELL * floor if on_bound(named.model) else 0.0
        return found.gain > -may_lose and len(alone.terms) <= len(named.findings)
    more = _words(named.model, beside) - _words(None, alone)
    return more >= 0.0 and found.gain > (-_AS_WELL * floor if more else 0.0)


def _words(laws: Model | None, terms: Learned | None) -> float:
    """How much an account says: every law, and of the terms as many as a joint has on average, of those that have any."""
    named = len(laws.applied) if laws is not None else 0
    if terms is None:
        return named
    return named + _TERM * a_joint([one.active for one in terms.terms])
