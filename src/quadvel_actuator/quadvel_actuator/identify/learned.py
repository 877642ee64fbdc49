"""What no named effect explains: readable terms of named signals, taken while held-out rows say that they pay.

One term is taken at a time: of those whose gain is as good as the best one's, the simplest. Gains, delays and the
effects named so far are free while it is fitted, so that a term is not paid for what they can explain. In the end
terms that the others made needless go, and the model is fitted once more beside those that stay.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from copy import copy

import attrs
import numpy as np

from ..effects.terms import Lag, Resonance, Shape, Term
from .delays import latest
from .features import Feature, Scene, library, lines
from .judging import Comparison, Judge
from .model import Model, gather, pack, step, with_slots
from .signals import Array, Bools

LEVEL = 0.01
"""A term is taken if chance would bring its gain with less than this probability, all that were tried counted."""

WORTH = 0.03
"""Least gain on a joint, as a share of its noise."""

MOST = 8
"""Terms at most."""

_TRIED = 100  # features a joint that count as independent trials
_KEPT = 12  # features that come into question after a look at all of them
_AS_GOOD = 0.9  # of the best one's gain: among these the simplest is taken
_RIDGE = 1e-6
_FREEDOM = 1e-3  # the same of the model's parameters, in shares of what they do to the joints that move most
_STEPS, _DAMPINGS, _SETTLED = 4, (1e-6, 1e-2, 1.0), 1e-3  # of the fit of model and terms together
_MOST_DAMPED = 0.7
_ENOUGH = 1500  # rows for a first look
_TUNING = (
    1.06,
    1.03,
    1.015,
    1.007,
)  # steps of a frequency; of dampings and time constants to the fourth power


@attrs.frozen(eq=False)
class Learned:
    """The terms that were taken, and the model fitted beside them."""

    model: Model
    terms: tuple[Term, ...]
    torque: Array  # (N, J), of all terms, N m
    gains: tuple[float, ...]  # of each term: held-out error without it less that with it, N^2 m^2
    columns: tuple[Array, ...]  # of each joint, what its terms are sums of, (N, K)

    @property
    def joints(self) -> Bools:
        """Those on which any term acts."""
        acts: Bools = np.any([term.active for term in self.terms], axis=0)
        return acts

    @property
    def inputs(self) -> list[str]:
        """All signals that the terms depend on, the weightiest first."""
        ranked = sorted(zip(self.gains, self.terms, strict=True), key=lambda pair: -pair[0])
        return list(dict.fromkeys(name for _, term in ranked for name in term.inputs))


def beside(model: Model, learned: Learned | None) -> Model:
    """The model on what was measured less the terms, if there are any."""
    if learned is None:
        return model
    samples = copy(model.samples)
    samples.tau, samples._parts = samples.tau - learned.torque, {}
    return attrs.evolve(model, samples=samples)


def longest(model: Model, learned: Learned | None, rows: Bools) -> Model:
    """The model with the longest delays with which it says the same of `rows`, together with the terms."""
    late = latest(beside(model, learned), rows)
    return model.with_delays(late.input_delay, late.output_delay)


@attrs.frozen(eq=False)
class _Pick:
    """A feature at work on the joints where it pays."""

    feature: Feature
    joints: Bools
    gain: float


def learn(model: Model, judge: Judge, noise: Array) -> Learned | None:
    """Terms for what `model` leaves; None where nothing pays."""
    scene = Scene(model, judge)
    picks: list[_Pick] = []
    kept: list[_Pick] = []
    left = scene.residual
    while len(picks) < MOST:
        fresh = [one for one in kept if one.feature.signal != "t"]
        kept = _paying(_again(fresh, scene, left), picks, scene, noise) if fresh else []
        if not kept:
            kept = _paying(library(scene, left), picks, scene, noise)
        if not kept:
            break
        picks.append(_simplest(kept))
        left = _Joint(picks, scene).left
    picks = _pruned(picks, scene, noise)
    if not picks:
        return None
    found = _fitted_beside(picks, scene)
    tau = model.samples.tau
    paid = judge.compare(tau - model.predict(), tau - found.model.predict() - found.torque)
    return found if paid.p_any < LEVEL else None  # fitted to all, they may give back what they promised


def leanings(model: Model, judge: Judge) -> tuple[str, ...]:
    """The signals that what `model` leaves goes with most clearly, whether or not a term of them would pay."""
    scene = Scene(model, judge)
    trial, every = Trial([], scene), np.ones(len(scene.joints), dtype=bool)
    best: tuple[str, ...] = ()
    least = 1.0
    for feature in library(scene, scene.residual):
        p = trial.compare(feature, scene.columns(feature), every).p_any
        if p < least:
            best, least = feature.key, p
    return best


def _again(kept: Sequence[_Pick], scene: Scene, left: Array) -> Iterator[Feature]:
    yield from (one.feature for one in kept)
    yield from lines(scene, left)


def _paying(features: Iterable[Feature], picks: Sequence[_Pick], scene: Scene, noise: Array) -> list[_Pick]:
    """Those that pay beside the picks, of the same signals the best one, best first."""
    trial = Trial(picks, scene)
    best: dict[tuple[str, ...], _Pick] = {}
    for feature in features:
        pick = _pick(feature, trial, noise)
        before = best.get(feature.key)
        if pick is not None and (before is None or pick.gain > before.gain):
            ranked = sorted([*(best | {feature.key: pick}).values()], key=lambda one: -one.gain)[:_KEPT]
            best = {one.feature.key: one for one in ranked}
    found = [_tuned(one, trial, noise) for one in best.values()]
    return sorted(found, key=lambda one: -one.gain)


def _pick(feature: Feature, trial: Trial, noise: Array) -> _Pick | None:
    """The feature on the joints where it pays; None where there are none."""
    promising = trial.promising(feature, noise)
    if not promising.any():
        return None
    columns = trial.scene.columns(feature)
    found = trial.compare(feature, columns, promising)
    taken = (found.p_joints * _TRIED * len(noise) < LEVEL) & (found.joint_gain > WORTH * noise)
    owner = feature.signal.rpartition("/")[0]
    taken &= np.array([name != owner for name in trial.scene.joints])
    gain = float((found.fall * taken).sum() / max(found.rows.sum(), 1))
    return _Pick(feature, taken, gain) if taken.any() else None


def _tuned(pick: _Pick, trial: Trial, noise: Array) -> _Pick:
    """The pick with the time constant, frequency or damping with which it says most of the fitted rows."""
    shape = pick.feature.shape
    if not _near(shape, _TUNING[0]):
        return pick
    least = trial.error(pick.feature, trial.scene.columns(pick.feature), pick.joints)
    for size in _TUNING:
        for moved in _near(shape, size):
            tried = attrs.evolve(pick.feature, shape=moved)
            error = trial.error(tried, trial.scene.columns(tried), pick.joints)
            if error < least:
                least, shape = error, moved
    found = _pick(attrs.evolve(pick.feature, shape=shape), trial, noise)
    return pick if found is None or found.gain < pick.gain else found


def _near(shape: Shape, size: float) -> list[Shape]:
    """The same with its times changed by a factor near `size`; none of shapes that have none."""
    if isinstance(shape, Lag):
        return [Lag(shape.time * size**by) for by in (4, -4)]
    if isinstance(shape, Resonance):
        sharp = [min(shape.damping * size**by, _MOST_DAMPED) for by in (4, -4)]
        return [
            *(Resonance(shape.frequency * size**by, shape.damping) for by in (1, -1)),
            *(Resonance(shape.frequency, damping) for damping in sharp),
        ]
    return []


class Trial:
    """What a feature would add to the picks: each joint's torque on the feature, the model and the picks left free."""

    def __init__(self, picks: Sequence[_Pick], scene: Scene) -> None:
        self.scene = scene
        parts = _Joint(picks, scene).parts
        sizes, rows = _sizes(scene), int(scene.judge.fit.sum(axis=0).max())
        self.others = []  # of each joint: (N, X), columns of size 1 over the fitted rows; slopes over those of all joints
        self.inverse = []
        self.few = slice(None, None, max(1, len(scene.residual) // _ENOUGH))
        self.onto = []  # of each joint: (X, n), weights of the columns that come closest on few of the fitted rows
        self.bare = np.empty_like(scene.residual)
        for j in range(len(scene.joints)):
            keep = scene.judge.fit[:, j]
            taken = np.column_stack([np.zeros((len(keep), 0)), *(part[:, j] for part in parts)])
            taken = taken / (np.sqrt(np.mean(taken[keep] ** 2, axis=0)) + 1e-12)
            x = np.hstack([scene.slopes[j].T / sizes, taken])
            ridge = np.repeat([_FREEDOM, _RIDGE], [len(sizes), len(parts)])
            gram = x[keep].T @ x[keep] + np.diag(ridge * rows)
            self.others.append(x)
            self.inverse.append(np.linalg.inv(gram))
            some = x[self.few][keep[self.few]]
            share = ridge * rows * len(some) / max(int(keep.sum()), 1)
            self.onto.append(np.linalg.lstsq(some.T @ some + np.diag(share), some.T, rcond=None)[0])
            self.bare[:, j] = self._without(j, scene.residual[:, j : j + 1])[:, 0]

    def _without(self, j: int, values: Array) -> Array:
        """What the other columns do not explain of `values` (N, K)."""
        x, keep = self.others[j], self.scene.judge.fit[:, j]
        left: Array = values - x @ (self.inverse[j] @ (x[keep].T @ values[keep]))
        return left

    def promising(self, feature: Feature, noise: Array) -> Bools:
        """The joints where the feature fitted to some of the rows gains more than chance would."""
        few = self.few
        columns, fit = self.scene.columns(feature, few), self.scene.judge.fit[few]
        found = np.zeros(len(noise), dtype=bool)
        for j, x in enumerate(self.others):
            keep = fit[:, j]
            left = self.bare[few, j][keep]
            b, x = columns[keep, :, min(j, columns.shape[2] - 1)], x[few][keep]
            b = b - x @ (self.onto[j] @ b)
            onto = b.T @ left
            gain = (onto @ _inverse(b, [feature.shape.penalty]) @ onto) / len(left)
            chance = float(np.mean(left * left)) * feature.shape.count / len(left)
            found[j] = gain - chance > 0.5 * WORTH * noise[j]
        return found

    def compare(self, feature: Feature, columns: Array, joints: Bools) -> Comparison:
        """Held-out residuals without the feature, and with it on these joints."""
        return self.scene.judge.compare(self.bare, self._after(feature, columns, joints))

    def error(self, feature: Feature, columns: Array, joints: Bools) -> float:
        """Sum of squares that the feature leaves of the fitted rows of these joints."""
        left = (self._after(feature, columns, joints) * self.scene.judge.fit)[:, joints]
        return float(np.sum(left * left))

    def _after(self, feature: Feature, columns: Array, joints: Bools) -> Array:
        """Residual (N, J) with the feature fitted to each of these joints."""
        after = self.bare.copy()
        for j in np.flatnonzero(joints).tolist():
            own = self._without(j, columns[:, :, min(j, columns.shape[2] - 1)])
            keep = self.scene.judge.fit[:, j]
            inverse = _inverse(own[keep], [feature.shape.penalty])
            after[:, j] -= own @ (inverse @ (own[keep].T @ self.bare[keep, j]))
        return after


def _sizes(scene: Scene) -> Array:
    """What each of the model's parameters does, root mean square over the fitted rows of the joint that shows it most.

    (A,). A joint that hardly moves while the model is fitted says nothing of them; it must not be free to make them up.
    """
    square = np.einsum("jan,nj->ja", scene.slopes**2, scene.judge.fit.astype(float))
    rows = np.maximum(scene.judge.fit.sum(axis=0), 1)
    sizes: Array = np.sqrt((square / rows[:, None]).max(axis=0)) + 1e-12
    return sizes


def _inverse(x: Array, penalties: Sequence[Array]) -> Array:
    """Of the second moments of x (N, K), each block of columns with its penalty, in shares of its mean square."""
    gram: Array = x.T @ x
    first = 0
    for penalty in penalties:
        last = first + len(penalty)
        size = float(np.trace(gram[first:last, first:last])) / len(penalty)
        gram[first:last, first:last] += size * penalty + 1e-12 * np.eye(len(penalty))
        first = last
    return np.asarray(np.linalg.inv(gram), dtype=np.float64)


class _Joint:
    """Picks fitted together to what the scene leaves; with `free` the model's parameters move, too, shared as they are."""

    def __init__(self, picks: Sequence[_Pick], scene: Scene, free: bool = True) -> None:
        joints = range(len(scene.joints))
        fit, slots = scene.judge.fit, scene.slots
        mine = [[k for k, pick in enumerate(picks) if pick.joints[j]] for j in joints]
        columns = [
            np.concatenate(
                [
                    np.zeros((len(fit), 0)),
                    *(scene.taken(picks[k].feature, picks[k].joints)[j] for k in mine[j]),
                ],
                axis=1,
            )
            for j in joints
        ]
        inverse = [
            _inverse(columns[j][fit[:, j]], [picks[k].feature.shape.penalty for k in mine[j]]) for j in joints
        ]

        def onto(j: int, values: Array) -> Array:
            """Weights of the joint's columns that come closest to `values` (N, ...)."""
            keep = fit[:, j]
            weights: Array = inverse[j] @ (columns[j][keep].T @ values[keep])
            return weights

        left = scene.residual.copy()
        self.hessian, self.gradient = np.zeros((slots.count, slots.count)), np.zeros(slots.count)
        if free:
            slopes = np.stack([scene.slopes[j] - (columns[j] @ onto(j, scene.slopes[j].T)).T for j in joints])
            slopes *= fit.T[:, None]
            rest = np.stack([left[:, j] - columns[j] @ onto(j, left[:, j]) for j in joints], axis=1)
            self.hessian = gather(slots, slopes @ slopes.transpose(0, 2, 1))
            self.gradient = gather(slots, np.einsum("jan,nj->ja", slopes, rest))
            size = np.diagonal(self.hessian) * _RIDGE + 1e-9
            moved = np.linalg.solve(self.hessian + np.diag(size), self.gradient)
            change = np.where(slots.index >= 0, moved[slots.index], 0.0)  # (A, J)
            left -= np.einsum("jan,aj->nj", scene.slopes, change)
        self.columns = tuple(columns)
        self.weights = [np.zeros((pick.feature.shape.count, len(joints))) for pick in picks]
        self.parts = [np.zeros_like(left) for _ in picks]
        for j in joints:
            solution, first = onto(j, left[:, j]), 0
            for k in mine[j]:
                last = first + picks[k].feature.shape.count
                self.weights[k][:, j] = solution[first:last]
                self.parts[k][:, j] = columns[j][:, first:last] @ solution[first:last]
                first = last
        self.left = np.where(scene.rows, left - sum(self.parts, start=np.zeros_like(left)), 0.0)


def _simplest(kept: Sequence[_Pick]) -> _Pick:
    """Of those that are as good as the best one, the one that says least."""
    good = [one for one in kept if one.gain >= _AS_GOOD * kept[0].gain]
    return min(good, key=lambda one: (*one.feature.size, -one.gain))


def _pruned(picks: list[_Pick], scene: Scene, noise: Array) -> list[_Pick]:
    """Without those that the others made needless."""
    while len(picks) > 1:
        whole = _Joint(picks, scene).left
        losses = []
        for k in range(len(picks)):
            less = _Joint(picks[:k] + picks[k + 1 :], scene).left
            found = scene.judge.compare(less, whole)
            on = picks[k].joints
            worth = float(np.max(np.where(on, found.joint_gain / noise, 0.0)))
            losses.append((worth if float(found.p_joints[on].min()) * _TRIED < LEVEL else 0.0, k))
        worst, k = min(losses)
        if worst > WORTH:
            break
        picks = picks[:k] + picks[k + 1 :]
    return picks


def _fitted_beside(picks: Sequence[_Pick], scene: Scene) -> Learned:
    """The model fitted beside the terms, and the terms beside it."""
    judge = scene.judge
    best, least = scene, float(np.sum((_Joint(picks, scene, free=False).left * judge.fit) ** 2))
    for _ in range(_STEPS):
        joint = _Joint(picks, best)
        theta = np.concatenate(
            [pack(best.model), best.model.input_delay[None], best.model.output_delay[None]]
        )
        error = least
        for damping in _DAMPINGS:
            after = step(best.slots, theta, joint.hessian, joint.gradient, damping)
            moved = with_slots(best.model, after[:-2]).with_delays(*np.round(after[-2:], 7))
            tried = Scene(moved, judge)
            left = float(np.sum((_Joint(picks, tried, free=False).left * judge.fit) ** 2))
            if left < least:
                least, best = left, tried
                break
        if least > error * (1.0 - _SETTLED):
            break
    return _as_terms(picks, best)


def _as_terms(picks: Sequence[_Pick], scene: Scene) -> Learned:
    joint, terms, parts = _Joint(picks, scene, free=False), [], []
    for pick, weights, torque in zip(picks, joint.weights, joint.parts, strict=True):
        bound = np.max(np.abs(torque) * scene.judge.fit, axis=0)
        feature = pick.feature
        terms.append(Term(feature.signal, feature.times, feature.shape, pick.joints, weights, bound))
        parts.append(np.clip(torque, -bound, bound))
    total: Array = np.sum(parts, axis=0)
    left = scene.residual - total
    gains = [scene.judge.compare(left + part, left).gain for part in parts]
    return Learned(scene.model, tuple(terms), total, tuple(gains), joint.columns)
