"""One floating forward search for the effects that a log shows: add, swap, drop.

Candidates are screened on top of the model so far, the most promising are fitted with everything else, and the one with
the least criterion on the rows that select is added if it passes the test. After each step every earlier effect is held
against the alternatives beside the others (swap), and left out (drop), as long as the criterion falls.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import cached_property
from typing import TypeVar

import attrs
import numpy as np

from quadvel_actuator.effects import EffectLaw

from . import library
from .criterion import LEVEL, PER_PARAMETER, WHITE_LEVEL, WORTH, Comparison, Parts, normality, whiteness
from .fit import fit, profiled
from .library import Context, SignalTerm, complexity
from .model import Applied, Groups, Model
from .parallel import side_by_side
from .screening import Screen, Screened, best_first
from .signals import Array, Bools

MOST = 5
"""Effects of one log at most"""
FITTED, FITTED_TERMS = 6, 4
"""Laws, and terms, that are fitted after a screening"""
NEAR = 0.5
"""Of the best candidate's worth: what is worth so much is its rival, and tried in its place once more is known"""
TIE = 0.02
"""Of the noise variance: laws whose errors differ by less cannot be told apart"""

LAWS, TERMS = "laws", "terms"
Tick = Callable[[str], None]
L = TypeVar("L", bound=EffectLaw)


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

    @cached_property
    def white(self) -> bool:
        """Is nothing left but noise, on the rows that fit and select?"""
        parts, samples = self.search.parts, self.model.samples
        p = whiteness(self.residual, parts.chosen_on, samples.start)
        p = np.minimum(p, normality(self.residual, parts.chosen_on))
        return bool((p * 2 * len(p) > WHITE_LEVEL).all())

    @property
    def last(self) -> Applied:
        return self.model.applied[-1]


def parameters(model: Model) -> float:
    """How many parameters a model has, each joint's own counted, those of the plain model not."""
    total = 2.0 * (len(np.unique(model.gain_groups[0])) + len(np.unique(model.delay_groups)) - 2)
    for one in model.applied:
        total += complexity(one.law) * len(np.unique(one.groups[one.active]))
    return total


class Search:
    """Searches on one set of data."""

    def __init__(self, parts: Parts, noise: Array, tick: Tick = lambda text: None, cores: int = 1) -> None:
        self.parts, self.noise, self.tick, self.cores = parts, noise, tick, cores
        self.rejected: dict[str, tuple[float, str]] = {}
        self.tried = 1
        self._near: dict[tuple[str, ...], set[tuple[str, ...]]] = {}
        self._known: dict[tuple[object, ...], _Pool] = {}

    def fitted(self, model: Model) -> Account:
        """The model fitted to the rows for that."""
        return Account(fit(model, self.parts.fit), self)

    def best(self, start: Model) -> Account:
        """The account of the data with the least criterion.

        Terms of named signals alone are one search, laws another, which ends where laws cost more than what terms leave;
        terms on top of the laws are the third. Nothing is sought where a residual is white.
        """
        plain = self.profiled(self.fitted(start))
        if plain.white:
            return plain
        first = self.run(plain, LAWS, most=1)
        if first.white:
            return self.simplified(first)
        terms = self.run(plain, TERMS)
        laws = self.simplified(self.run(first, LAWS, bound=terms.criterion))
        accounts = [terms, laws, self.merged(laws)]
        if not laws.white:
            accounts.append(self.run(laws, TERMS))
        return self.simplified(min(accounts, key=lambda one: one.criterion))

    def profiled(self, account: Account) -> Account:
        """With its delays sought on a grid once more: what was added may have hidden the right ones."""
        return min(
            account, Account(profiled(account.model, self.parts.fit), self), key=lambda one: one.criterion
        )

    def laws_alone(self, account: Account) -> Account:
        """The account without its terms."""
        laws = tuple(one for one in account.model.applied if not isinstance(one.law, SignalTerm))
        return self.fitted(attrs.evolve(account.model, applied=laws))

    def leaning(self, account: Account) -> tuple[str, ...]:
        """The signals that what is left goes with most, whether or not a term of them would pay."""
        terms = self._pool(account).terms
        best = min(terms, key=lambda one: one.criterion, default=None)
        return () if best is None else best.last.law.inputs  # type: ignore[attr-defined]

    def simplified(self, account: Account) -> Account:
        """Without what costs more than it is worth: effects, joints of effects, values and gains of each joint."""
        account = self.dropped(account)
        for k in range(len(account.model.applied)):
            account = self.narrowed(account, k)
        model, one = account.model, np.zeros(len(self.noise), dtype=np.intp)
        if model.gain_groups.any():
            shared = self.fitted(
                attrs.evolve(model, gains=_shared(model.gains), gain_groups=np.array([one, one]))
            )
            account = min(account, shared, key=lambda each: each.criterion)
        if model.delay_groups.any():
            same = attrs.evolve(account.model, delay_groups=one).with_delays(_shared(model.delays))
            account = min(account, self.fitted(same), key=lambda each: each.criterion)
        return self.tied(account)

    def run(self, best: Account, kinds: str, most: int = MOST, bound: float = np.inf) -> Account:
        """The account with candidates of these kinds added while it pays and might come below `bound`."""
        while len(best.model.applied) < most and not best.white:
            self.tick(f"effect {len(best.model.applied) + 1}")
            more = self._added(best, kinds)
            if more is None:
                break
            best = self.profiled(self._floated(more, kinds))
            if len(best.left) + PER_PARAMETER * parameters(best.model) > bound:
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
        """Keep in mind what is worth nearly as much as the best candidate: it may be right beside what comes later."""
        fall = [before.criterion - one.criterion for one in candidates]
        if fall:
            near = {
                _key(one.last.law)
                for one, by in zip(candidates, fall, strict=True)
                if one.model.applied and by > NEAR * fall[0]
            }
            for key in near:
                self._near.setdefault(key, set()).update(near)

    def _reason(self, before: Account, after: Account) -> str:
        """Why what was added does not count; nothing where it does."""
        found = after.against(before)
        p = found.p * self.tried
        worth = float(np.max(found.joint_gain / self.noise))
        if p >= LEVEL:
            return (
                f"not significant on rows that select (p = {min(p, 1.0):.2g} after {self.tried} candidates)"
            )
        if worth <= WORTH:
            return f"worth {100 * worth:.1f} % of the noise, below {100 * WORTH:.0f} %"
        return "" if after.criterion < before.criterion else "costs more parameters than it is worth"

    def _pool(self, before: Account) -> _Pool:
        """The candidates on top of an account; kept, as several searches come by."""
        key = _described(before.model)
        if key not in self._known:
            self._known[key] = _Pool(before, self)
        return self._known[key]

    def _candidates(self, before: Account, kinds: str) -> list[Account]:
        """The most promising candidates of these kinds on top of an account, fitted."""
        pool = self._pool(before)
        self.tried = pool.tried(kinds)
        return pool.laws if kinds == LAWS else pool.terms

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

    def _floated(self, account: Account, kinds: str) -> Account:
        """The account after drops, and swaps while its residual is not white, that lessen the criterion."""
        for _ in range(MOST):
            before = account
            account = self.dropped(account)
            account = account if account.white else self._swapped(account, kinds)
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

    def _swapped(self, account: Account, kinds: str) -> Account:
        """With one effect in another's place, if that lessens the criterion."""
        if len(account.model.applied) < 2:
            return account
        for k in range(len(account.model.applied) - 1):
            one = account.model.applied[k].law
            rest = self.fitted(account.model.without(k))
            names = {name for name in self._near.get(_key(one), ()) if name != _key(one)}
            pool = _Pool(rest, self, names)
            for other in pool.laws if kinds == LAWS else pool.terms:
                if other.criterion < account.criterion - PER_PARAMETER:
                    return other
        return account

    def merged(self, account: Account) -> Account:
        """With a curve over a signal in the place of several laws of that signal, if that lessens the criterion.

        Laws of one signal add up to any shape of it: a spring and cogging to a stop, for one.
        """
        signals = [one.law.signal for one in account.model.applied if not isinstance(one.law, SignalTerm)]
        for signal in {one for one in signals if signals.count(one) > 1}:
            kept = tuple(one for one in account.model.applied if one.law.signal != signal)
            rest = self.fitted(attrs.evolve(account.model, applied=kept))
            every = [account, *_Pool(rest, self, {(signal,)}).terms]
            account = min(every, key=lambda one: one.criterion)
        return account

    def tied(self, account: Account) -> Account:
        """With the values of each effect shared by its joints, or by those of a kind, where that costs nothing."""
        for k in range(len(account.model.applied)):
            one = account.model.applied[k]
            for groups in (
                np.zeros(len(one.active), dtype=np.intp),
                *_groupings(account.model.samples.joints),
            ):
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
        one = account.model.applied[index].law
        if isinstance(one, SignalTerm):
            return ()
        rest = self.fitted(account.model.without(index))
        alone = len(account.model.applied) == 1
        pool = self._pool(rest) if alone else _Pool(rest, self, self._near.get(_key(one), set()))
        found = []
        for other in pool.laws:
            lost = account.against(other)
            if other.last.law.name != one.name and (lost.joint_gain < TIE * self.noise).all():
                found.append(other.last.law.name)
        return tuple(dict.fromkeys(found))


class _Pool:
    """The candidates on top of an account, fitted, the most promising first."""

    def __init__(
        self, before: Account, search: Search, among: Collection[tuple[str, ...]] | None = None
    ) -> None:
        """`among`: the names of laws, and signals of terms, that are looked at; all without it."""
        self._before, self._search, self._among = before, search, among
        self._context = Context(before.model, search.parts, search.noise)
        self._screen = Screen(self._context)

    def _asked(self, candidates: Iterable[L]) -> Iterator[L]:
        return (one for one in candidates if self._among is None or _key(one) in self._among)

    def tried(self, kinds: str) -> int:
        """How many laws, or sets of signals, were looked at."""
        return self._laws[1] if kinds == LAWS else self._terms[1]

    @property
    def laws(self) -> list[Account]:
        return self._laws[0]

    @property
    def terms(self) -> list[Account]:
        return self._terms[0]

    @cached_property
    def _laws(self) -> tuple[list[Account], int]:
        found = list(self._screen.laws(self._asked(library.laws(self._context))))
        count = len({one.law.name for one in found}) or 1
        return self._fitted(_distinct(best_first(found), FITTED)), count

    @cached_property
    def _terms(self) -> tuple[list[Account], int]:
        found = list(self._screen.terms(self._asked(library.terms(self._context))))
        best = [self._refined(one) for one in _distinct(best_first(found), FITTED_TERMS)]
        return self._fitted(best), len({_key(one.law) for one in found})

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
        search, samples = self._search, self._context.samples
        models = side_by_side(lambda k: self._fit(chosen[k]), len(chosen), search.cores, samples)
        return [Account(one, search) for one in models if one is not None]

    def _fit(self, one: Screened) -> Model | None:
        """The candidate fitted on all joints, or on those that it acts on, whichever is better."""
        search, model = self._search, one.model
        if one.law.gainlike:
            fewer = _without_weakest(fit(model, search.parts.fit, 4))
            if fewer is None:
                return None
            model = fewer
        starts = [model, model.with_delays(self._before.model.delays)] if one.law.shifts else [model]
        every = min((search.fitted(start) for start in starts), key=lambda one: one.criterion)
        return search.narrowed(every, len(every.model.applied) - 1).model


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
        key = _key(one.law)
        if sum(_key(other.law) == key for other in chosen) < (1 if isinstance(one.law, SignalTerm) else 2):
            chosen.append(one)
        if len(chosen) == most:
            break
    return chosen


def _key(law: EffectLaw) -> tuple[str, ...]:
    return law.inputs if isinstance(law, SignalTerm) else (law.name,)


def _shared(values: Array) -> Array:
    """The mean over the joints, for each of them."""
    return np.repeat(values.mean(axis=-1, keepdims=True), values.shape[-1], axis=-1)


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
