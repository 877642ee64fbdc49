"""One floating forward search for the effects that a log shows: add, swap, drop.

Candidates are screened on top of the model so far, the most promising are fitted with everything else, and the one with
the least criterion on the rows that select is added if it passes the test. After each step every earlier effect is held
against the alternatives beside the others (swap), and left out (drop), as long as the criterion falls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property

import attrs
import numpy as np

from . import library
from .criterion import LEVEL, PER_PARAMETER, WORTH, Comparison, Parts
from .engine.signals import Array, Bools
from .fit import fit
from .library import Context, SignalTerm, complexity
from .model import Applied, Groups, Model
from .screening import Screen, Screened, best_first

MOST = 5
"""Effects of one log at most"""
FITTED = 6
"""Candidates that are fitted after a screening"""
RIVALS = 3
"""Candidates that are fitted in the place of an effect that is there"""
TIE = 0.02
"""Of the noise variance: laws whose errors differ by less cannot be told apart"""

Tick = Callable[[str], None]


@attrs.frozen(eq=False)
class Account:
    """A fitted model, and what it is worth on the rows that select."""

    model: Model
    search: Search

    @cached_property
    def residual(self) -> Array:
        """Measured less predicted torque, (N, J)."""
        return self.model.residual()

    @cached_property
    def left(self) -> Array:
        """Mean squared error of the rows that select, in units of the noise variance, (J,)."""
        rows = self.search.parts.select
        square = np.sum(np.where(rows, self.residual, 0.0) ** 2, axis=0)
        left: Array = square / np.maximum(rows.sum(axis=0), 1) / self.search.noise
        return left

    @cached_property
    def criterion(self) -> float:
        """Error of all joints and what the parameters cost."""
        return float(self.left.sum()) + PER_PARAMETER * parameters(self.model)

    def against(self, before: Account) -> Comparison:
        """On the rows that select."""
        return self.search.parts.compare(before.residual, self.residual, self.search.parts.select)

    @property
    def last(self) -> Applied:
        return self.model.applied[-1]


def parameters(model: Model) -> float:
    """How many parameters a model has, each joint's own counted, those of the plain model not."""
    total = 2.0 * (len(np.unique(model.gain_groups[0])) + len(np.unique(model.delay_groups)) - 2)
    for one in model.applied:
        total += complexity(one.law) * len(np.unique(one.groups[one.active]))
    return total


@attrs.frozen(eq=False)
class Found:
    """What the search chose: effects in the order of model.applied, with the names of their equals."""

    account: Account
    rivals: tuple[tuple[str, ...], ...]
    rejected: tuple[tuple[str, float, str], ...]
    """law, gain (N^2 m^2), reason"""


class Search:
    """Searches on one set of data."""

    def __init__(self, parts: Parts, noise: Array, tick: Tick = lambda text: None) -> None:
        self.parts, self.noise, self.tick = parts, noise, tick
        self.rejected: dict[str, tuple[float, str]] = {}
        self.tried = 1
        self._known: dict[tuple[object, ...], _Pool] = {}

    def fitted(self, model: Model) -> Account:
        """The model fitted to the rows for that."""
        return Account(fit(model, self.parts.fit), self)

    def run(self, start: Model, with_terms: bool) -> Account:
        """The best account from a start, with laws alone or with terms, too."""
        best = self.fitted(start)
        while len(best.model.applied) < MOST:
            self.tick(f"effect {len(best.model.applied) + 1}")
            more = self._added(best, with_terms)
            if more is None:
                break
            best = self._floated(more, with_terms)
        return best

    def _added(self, before: Account, with_terms: bool) -> Account | None:
        """The account with the candidate more that has the least criterion; None where none passes."""
        candidates = [*self._candidates(before, with_terms, FITTED), *self._regrouped(before)]
        for one in sorted(candidates, key=lambda one: one.criterion):
            reason = self._reason(before, one)
            if not reason:
                return one
            if len(one.model.applied) > len(before.model.applied):
                self.rejected.setdefault(one.last.law.name, (one.against(before).gain, reason))
        return None

    def _reason(self, before: Account, after: Account) -> str:
        """Why what was added does not count; nothing where it does."""
        found = after.against(before)
        p = found.p * self.tried
        worth = float(np.max(found.joint_gain / self.noise))
        if p >= LEVEL:
            return f"not significant on rows that select (p = {min(p, 1.0):.2g} after {self.tried} candidates)"
        if worth <= WORTH:
            return f"worth {100 * worth:.1f} % of the noise, below {100 * WORTH:.0f} %"
        return "" if after.criterion < before.criterion else "costs more parameters than it is worth"

    def _candidates(self, before: Account, with_terms: bool, most: int) -> list[Account]:
        """The most promising candidates on top of an account, fitted; kept, as several searches come by."""
        key = _described(before.model)
        if key not in self._known:
            self._known[key] = _Pool(before, self)
        pool = self._known[key]
        self.tried = pool.tried(with_terms)
        return [*pool.laws[: 2 * most], *(pool.terms[:most] if with_terms else ())]

    def narrowed(self, every: Account, index: int) -> Account:
        """The account with an effect on the joints alone that need it, where that is better."""
        one = every.model.applied[index]
        idle = Account(every.model.without(index), self)
        found = every.against(idle)
        cost = PER_PARAMETER * complexity(one.law) * self.noise
        needed = one.active & (found.p_joints < LEVEL) & (found.joint_gain > cost)
        if not needed.any() or (needed == one.active).all():
            return every
        fewer = self.fitted(every.model.replacing(index, attrs.evolve(one, active=needed)))
        return min(every, fewer, key=lambda one: one.criterion)

    def _regrouped(self, before: Account) -> list[Account]:
        """The account with gains, or delays, for each kind of joint and for each joint."""
        model, joints = before.model, before.model.samples.joints
        found = []
        for groups in _groupings(joints):
            finer = len(np.unique(groups))
            if not model.gains_held and finer > len(np.unique(model.gain_groups[0])):
                found.append(attrs.evolve(model, gain_groups=np.array([groups, groups])))
            if finer > len(np.unique(model.delay_groups)):
                found.append(attrs.evolve(model, delay_groups=groups))
        return [self.fitted(one) for one in found]

    def _floated(self, account: Account, with_terms: bool) -> Account:
        """The account after swaps and drops that lessen the criterion."""
        for _ in range(MOST):
            before = account
            account = self.dropped(account)
            account = self._swapped(account, with_terms)
            if account is before:
                return account
        return account

    def dropped(self, account: Account) -> Account:
        """Without the effects that the others made needless (backward elimination)."""
        while len(account.model.applied) > 1:
            every = [self.fitted(account.model.without(k)) for k in range(len(account.model.applied))]
            least = min(every, key=lambda one: one.criterion)
            if self._needed(least, account):
                return account
            account = least
        return account

    def _needed(self, without: Account, account: Account) -> bool:
        found = account.against(without)
        worth = float(np.max(found.joint_gain / self.noise))
        return account.criterion < without.criterion and worth > WORTH and found.p < LEVEL

    def _swapped(self, account: Account, with_terms: bool) -> Account:
        """With one effect in another's place, if that lessens the criterion."""
        if len(account.model.applied) < 2:
            return account
        for k in range(len(account.model.applied) - 1):
            rest = self.fitted(account.model.without(k))
            name = account.model.applied[k].law.name
            for one in self._candidates(rest, with_terms, RIVALS):
                other = one.last.law
                same = other.name == name and not isinstance(other, SignalTerm)
                if one.criterion < account.criterion - (0.0 if same else PER_PARAMETER):
                    account = one
                    return account
        return account

    def tied(self, account: Account) -> Account:
        """With the values of each effect shared by its joints, or by those of a kind, where that costs nothing."""
        for k in range(len(account.model.applied)):
            one = account.model.applied[k]
            for groups in (np.zeros(len(one.active), dtype=np.intp), *_groupings(account.model.samples.joints)):
                if len(np.unique(groups[one.active])) >= len(np.unique(one.groups[one.active])):
                    continue
                values = one.values.copy()
                for g in np.unique(groups[one.active]):
                    alike = one.active & (groups == g)
                    values[:, alike] = values[:, alike].mean(axis=1, keepdims=True)
                shared = attrs.evolve(one, groups=groups, values=values)
                tied = self.fitted(account.model.replacing(k, shared))
                if tied.criterion < account.criterion:
                    account = tied
                    break
        return account

    def rivals(self, account: Account, index: int) -> tuple[str, ...]:
        """The laws that say the same in the place of an effect, to what rows that select can tell."""
        name = account.model.applied[index].law.name
        rest = self.fitted(account.model.without(index))
        found = []
        for one in self._candidates(rest, False, RIVALS):
            lost = account.against(one)
            if one.last.law.name != name and (lost.joint_gain < TIE * self.noise).all():
                found.append(one.last.law.name)
        return tuple(dict.fromkeys(found))


class _Pool:
    """The candidates on top of an account, fitted, the most promising first."""

    def __init__(self, before: Account, search: Search) -> None:
        self._before, self._search = before, search
        self._context = Context(before.model, search.parts, search.noise)
        self._screen = Screen(self._context)

    def tried(self, with_terms: bool) -> int:
        """How many laws, and sets of signals, were looked at."""
        return self._laws[1] + (self._terms[1] if with_terms else 0)

    @property
    def laws(self) -> list[Account]:
        return self._laws[0]

    @property
    def terms(self) -> list[Account]:
        return self._terms[0]

    @cached_property
    def _laws(self) -> tuple[list[Account], int]:
        found = list(self._screen.laws(library.laws(self._context)))
        count = len({one.law.name for one in found}) or 1
        return self._fitted(_distinct(best_first(found), FITTED)), count

    @cached_property
    def _terms(self) -> tuple[list[Account], int]:
        found = list(self._screen.terms(library.terms(self._context)))
        best = [self._refined(one) for one in _distinct(best_first(found), FITTED)]
        return self._fitted(best), len({_key(one) for one in found})

    def _refined(self, one: Screened) -> Screened:
        """A term with its place and time constants where it promises most."""
        for _ in range(3):
            assert isinstance(one.law, SignalTerm)
            near = self._screen.terms(library.refined(one.law))
            better = max(near, key=lambda other: other.promise, default=one)
            if better.promise <= one.promise:
                break
            one = better
        return one

    def _fitted(self, chosen: Sequence[Screened]) -> list[Account]:
        return [account for one in chosen if (account := self._fit(one)) is not None]

    def _fit(self, one: Screened) -> Account | None:
        """The candidate fitted on all joints, or on those that it acts on, whichever is better."""
        search, model = self._search, one.model
        if one.law.gainlike:
            fewer = _without_weakest(fit(model, search.parts.fit, 4))
            if fewer is None:
                return None
            model = fewer
        starts = [model, model.with_delays(self._before.model.delays)] if one.law.shifts else [model]
        every = min((search.fitted(start) for start in starts), key=lambda one: one.criterion)
        return search.narrowed(every, len(every.model.applied) - 1)


def _described(model: Model) -> tuple[object, ...]:
    """What tells two fitted models apart: their laws, forms and joints, and what is shared."""
    effects = [
        (one.law.name, str(one.law.settings), one.active.tobytes(), one.groups.tobytes())
        for one in model.applied
    ]
    return (*sorted(effects), model.gain_groups.tobytes(), model.delay_groups.tobytes(), model.gains_held)


def _distinct(found: Sequence[Screened], most: int) -> list[Screened]:
    """The first so many with different names, or signals, and of each name at most two forms."""
    chosen: list[Screened] = []
    for one in found:
        key = _key(one)
        if sum(_key(other) == key for other in chosen) < (1 if isinstance(one.law, SignalTerm) else 2):
            chosen.append(one)
        if len(chosen) == most:
            break
    return chosen


def _key(one: Screened) -> tuple[str, ...]:
    return one.law.inputs if isinstance(one.law, SignalTerm) else (one.law.name,)


def _without_weakest(model: Model) -> Model | None:
    """The last effect off the joint where it is weakest, which gains or delays then stand for; None of one joint."""
    last = model.applied[-1]
    if last.active.sum() < 2:
        return None
    active: Bools = last.active & (np.arange(len(last.active)) != np.argmin(np.abs(last.values[0])))
    return model.replacing(len(model.applied) - 1, attrs.evolve(last, active=active))


def kinds(joints: Iterable[str]) -> Groups:
    """The same number for joints whose names differ in their first part only: FR_hip_joint, FL_hip_joint."""
    names = [name.partition("_")[2] or name for name in joints]
    found: Groups = np.unique(names, return_inverse=True)[1]
    return found


def _groupings(joints: Sequence[str]) -> list[Groups]:
    """By kind, and each joint for itself; by kind only where several joints are of one."""
    each = np.arange(len(joints))
    by_kind = kinds(joints)
    return [by_kind, each] if by_kind.max() + 1 < len(joints) else [each]
