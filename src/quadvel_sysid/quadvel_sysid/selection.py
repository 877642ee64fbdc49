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

from .account import Account, Judge, groupings
from .candidates import LAWS, TERMS, Candidates, key
from .criterion import LEVEL, WORTH
from .library import SignalTerm
from .model import Applied, Model
from .signals import Array

MOST = 5
"""Effects of one log at most"""
NEAR = 0.5
"""Of the best candidate's worth: what is worth so much is its rival, which may say the same"""
TIE = 0.02
"""Of a joint's error: laws whose errors differ by less cannot be told apart"""

Tick = Callable[[str], None]


class Search:
    """Searches on one set of data."""

    def __init__(self, judge: Judge, tick: Tick = lambda text: None) -> None:
        self.judge, self._tick = judge, tick
        self.rejected: dict[str, tuple[float, str]] = {}
        self._tried = 1
        self._near: dict[tuple[str, ...], set[tuple[str, ...]]] = {}
        self._known: dict[tuple[object, ...], Candidates] = {}

    def best(self, start: Model) -> tuple[Account, Account]:
        """The account of the data with the least criterion, and the best one without terms.

        Nothing is sought where a residual is white. Up to two laws are held against one term of named signals. Where these
        laws leave more than noise, terms alone come into question; and where those do so, too, or cost more, further laws,
        and terms on top of the laws.
        """
        plain = self.judge.profiled(self.judge.fitted(start))
        if plain.white:
            return plain, plain
        laws = self.run(plain, LAWS, most=1)
        if laws.white:
            laws = self.simplified(laws)
            return laws, laws
        terms = self.run(plain, TERMS, most=1)
        laws = self.run(laws, LAWS, most=2, bound=terms.criterion)
        if not laws.white:
            terms = self.run(terms, TERMS)
        accounts = [terms]
        if laws.white or not terms.white or laws.criterion < terms.criterion:
            laws = self.simplified(self.run(laws, LAWS, bound=terms.criterion))
            accounts += [laws] if laws.white else [laws, self.run(laws, TERMS, bound=terms.criterion)]
        least = min(one.criterion for one in accounts)
        alike = [one for one in accounts if one.criterion < least + TIE * len(self.judge.noise)]
        return self.simplified(min(alike, key=_terms)), laws

    def leaning(self, account: Account) -> tuple[str, ...]:
        """The signals that what is left goes with most, whether or not a term of them would pay."""
        terms, _ = self._pool(account).found(TERMS)
        best = min(terms, key=lambda one: one.criterion, default=None)
        return () if best is None else best.last.law.inputs  # type: ignore[attr-defined]

    def simplified(self, account: Account) -> Account:
        """Without what costs more than it is worth: effects, joints of effects, values and gains of each joint."""
        account = self.dropped(account)
        for k in range(len(account.model.applied)):
            account = self._nested(self.judge.narrowed(self._nested(account, k), k), k)
        model, one = account.model, np.zeros(len(self.judge.noise), dtype=np.intp)
        if model.gain_groups.any():
            shared = self.judge.fitted(attrs.evolve(model, gains=_shared(model.gains), gain_groups=one))
            account = min(account, shared, key=lambda each: each.criterion)
        if model.delay_groups.any():
            same = attrs.evolve(account.model, delay_groups=one).with_delays(_shared(model.delays))
            account = min(account, self.judge.fitted(same), key=lambda each: each.criterion)
        for k in range(len(account.model.applied)):
            account = self.judge.tied(account, k)
        return account

    def shorter(self, account: Account) -> list[Account]:
        """The account with fewer of its effects, those that were found first, the most of them first."""
        model = account.model
        return self.judge.each_fitted(
            [attrs.evolve(model, applied=model.applied[:k]) for k in range(len(model.applied) - 1, 0, -1)]
        )

    def _nested(self, account: Account, index: int) -> Account:
        """With the effect's law replaced by its special case, as Stribeck friction by Coulomb's, unless selecting rows need it."""
        one = account.model.applied[index]
        less = one.law.simpler(dict(zip(one.law.names, one.values, strict=True)))
        if less is None:
            return account
        law, start = less
        values = np.array([start[name] for name in law.names])
        other = self.judge.fitted(account.model.replacing(index, attrs.evolve(one, law=law, values=values)))
        return account if self._needed(other, account) else other

    def run(self, best: Account, kinds: str, most: int = MOST, bound: float = np.inf) -> Account:
        """The account with candidates of these kinds added while it pays and may come below `bound`.

        Effects are taken to gain less one by one, so that what the last one gained tells how far the others may get.
        """
        while len(best.model.applied) < most and not best.white:
            self._tick(f"effect {len(best.model.applied) + 1}")
            before, more = best, self._added(best, kinds)
            if more is None:
                break
            best = self.judge.profiled(self.dropped(more, kept=1))
            gained, left = before.criterion - best.criterion, most - len(best.model.applied)
            if best.criterion - left * gained > bound:
                break
        return best

    def _added(self, before: Account, kinds: str) -> Account | None:
        """The account with the candidate more that has the least criterion; None where none passes."""
        candidates = [*self._candidates(before, kinds), *self._regrouped(before)]
        candidates.sort(key=lambda one: one.criterion)
        self._note_rivals(before, candidates)
        for one in candidates:
            reason = self._reason(before, one)
            if not reason:
                return one
            if len(one.model.applied) > len(before.model.applied):
                self.rejected.setdefault(one.last.law.name, (one.against(before).gain, reason))
        return None

    def _note_rivals(self, before: Account, candidates: Sequence[Account]) -> None:
        """Keep in mind what is worth nearly as much as the best candidate: it may say the same."""
        fall = [before.criterion - one.criterion for one in candidates]
        if fall:
            near = {
                key(one.last.law)
                for one, by in zip(candidates, fall, strict=True)
                if len(one.model.applied) > len(before.model.applied) and by > NEAR * fall[0]
            }
            for name in near:
                self._near.setdefault(name, set()).update(near)

    def _reason(self, before: Account, after: Account) -> str:
        """Why what was added does not count; nothing where it does."""
        grown = len(after.model.applied) > len(before.model.applied)
        if grown and repeats(after.last, before.model.applied):
            return "a law that it contains, or that contains it, is on the same joints already"
        if grown and not after.last.shown(after.model.signals):
            return "the joints moved too little to tell it from other laws"
        found = after.against(before)
        p = found.p * self._tried
        worth = float(np.max(found.share))
        if p >= LEVEL:
            return (
                f"not significant on rows that select (p = {min(p, 1.0):.2g} after {self._tried} candidates)"
            )
        if worth <= WORTH:
            return f"takes {100 * worth:.1f} % off the error of a joint, below {100 * WORTH:.0f} %"
        return "" if after.criterion < before.criterion else "costs more parameters than it is worth"

    def _pool(self, before: Account) -> Candidates:
        """The candidates on top of an account; kept, as several searches come by."""
        model = _described(before.model)
        if model not in self._known:
            self._known[model] = Candidates(before)
        return self._known[model]

    def _candidates(self, before: Account, kinds: str) -> list[Account]:
        """The most promising candidates of these kinds on top of an account, fitted."""
        found, self._tried = self._pool(before).found(kinds)
        return found

    def _regrouped(self, before: Account) -> list[Account]:
        """The account with gains, or delays, for each kind of joint and for each joint."""
        model, joints = before.model, before.model.samples.joints
        found = []
        for groups in groupings(joints):
            finer = len(np.unique(groups))
            if finer > len(np.unique(model.gain_groups)):
                found.append(attrs.evolve(model, gain_groups=groups))
            if finer > len(np.unique(model.delay_groups)):
                found.append(attrs.evolve(model, delay_groups=groups))
        return self.judge.each_fitted(found)

    def dropped(self, account: Account, kept: int = 0) -> Account:
        """Without the effects that the others made needless (backward elimination), but with the last `kept` ones."""
        while len(account.model.applied) > max(kept, 1):
            model = account.model
            among = range(len(model.applied) - kept)
            least = min(
                self.judge.each_fitted([model.without(k) for k in among]), key=lambda one: one.criterion
            )
            if self._needed(least, account):
                return account
            account = least
        return account

    def _needed(self, without: Account, account: Account) -> bool:
        found = account.against(without)
        worth = float(np.max(found.share))
        return account.criterion < without.criterion and worth > WORTH and found.p < LEVEL

    def rivals(self, account: Account, index: int) -> tuple[str, ...]:
        """The laws that say the same in the place of an effect, to what rows that select can tell."""
        one = account.model.applied[index].law
        if isinstance(one, SignalTerm):
            return ()
        rest = self.judge.fitted(account.model.without(index))
        alone = len(account.model.applied) == 1
        pool = self._pool(rest) if alone else Candidates(rest, self._near.get(key(one), set()))
        found = []
        for other in pool.found(LAWS)[0]:
            lost = account.against(other)
            if other.last.law.name != one.name and (lost.share < TIE).all():
                found.append(other.last.law.name)
        return tuple(dict.fromkeys(found))


def _terms(account: Account) -> tuple[int, float]:
    """How many terms of named signals there are in an account, whose laws say more to who reads them; and its criterion."""
    return sum(isinstance(one.law, SignalTerm) for one in account.model.applied), account.criterion


def repeats(one: Applied, others: Iterable[Applied]) -> bool:
    """Does a law act where a law is at work that it contains as an end of its parameters, or that contains it?"""
    mine = _contained(one.law)
    return any(not (one.active & ~other.active).any() and mine & _contained(other.law) for other in others)


def _contained(law: EffectLaw) -> set[str]:
    """The names of a law and of that which it becomes at the end of one of its parameters; none of a term."""
    if isinstance(law, SignalTerm):
        return set()
    less = law.simpler({p.name: np.array([p.scale]) for p in law.parameters})
    return {law.name} | ({less[0].name} if less else set())


def _described(model: Model) -> tuple[object, ...]:
    """What tells two fitted models apart: their laws, forms and joints, and what is shared."""
    effects = [
        (one.law.name, str(one.law.settings), one.active.tobytes(), one.groups.tobytes())
        for one in model.applied
    ]
    return (*sorted(effects), model.gain_groups.tobytes(), model.delay_groups.tobytes())


def _shared(values: Array) -> Array:
    """The mean over the joints, for each of them."""
    return np.repeat(values.mean(axis=-1, keepdims=True), values.shape[-1], axis=-1)
