"""What no named effect explains: readable terms of named signals, taken while held-out rows say that they pay.

One term is taken at a time: of those whose gain is as good as the best one's, the simplest. Gains, delays and the
effects named so far are free while it is fitted, so that a term is not paid for what they can explain. In the end
terms that the others made needless go, and the model is fitted once more beside those that stay.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from functools import cached_property
from typing import Any

import attrs
import numpy as np

from quadvel_actuator.effects import DRIVE, JOINT
from quadvel_actuator.effects.terms import Lag, Resonance, Shape, Term

from .ahead import side_by_side
from .delays import latest
from .features import Feature, Scene, library, lines
from .judging import Judge
from .model import Model, pack, step, with_slots
from .picks import WORTH, Pick, Picks, Together, Trial, columns_of
from .signals import Array, Bools

LEVEL = 0.01
"""A term is taken if chance would bring its gain with less than this probability, all that were tried counted."""

MOST = 8
"""Terms at most."""

_PART = 50
"""Features that one core looks at before it is given others"""
_TRIED = 100  # features a joint that count as independent trials
_KEPT = 12  # features that come into question after a look at all of them
_FITTED = 4  # of these that the model is fitted beside
_MOST_JOINTS, _FAR_LESS = 0.5, 0.7
"""On more of the joints than that a feature is tried on all, and stays there if it leaves less than that of the error"""
_AS_GOOD, _NEARLY = 0.9, 1.02
"""Of the best one's gain: of these that of fewest signals is taken; and of its error: of these that of fewest numbers"""
_STEPS, _DAMPINGS, _SETTLED = 4, (1e-6, 1e-2, 1.0), 1e-3  # of the fit of model and terms together
_MOST_DAMPED = 0.7
_TUNING = 1.06, 1.03, 1.015, 1.007  # steps of a frequency; of dampings and time constants to the fourth power


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


def learn(model: Model, judge: Judge, noise: Array, cores: int = 1, enough: float = np.inf) -> Learned | None:
    """Terms for what `model` leaves; None where nothing pays. `cores` share the work.

    Gains that are held are left free as soon as terms let them stay near those commanded. No more terms are sought once
    there are more than `enough` a joint.
    """
    state = _State((), Scene(model, judge))
    kept: list[Picks] = []
    for _ in range(MOST):
        kept = _promising(state, kept, noise, cores)
        grown = _grown(state, kept[:_FITTED], cores)
        better = [one for one in grown if one.left < state.left]
        if not better:
            break
        state = _simplest(better, state.left).state(judge).released()
        if a_joint([pick.joints for pick in state.picks]) > enough:
            break
    state = _narrowed(_pruned(state, noise), noise)
    tau = model.samples.tau
    while state.picks:
        found = _as_terms(state)
        paid = judge.compare(tau - model.predict(), tau - found.model.predict() - found.torque)
        if paid.gain > 0.0 and paid.p_any < LEVEL:
            return found
        state = _State(state.picks[:-1], state.scene).settled()  # bounded, they gave back what they promised
    return None


def _grown(state: _State, kept: Sequence[Picks], cores: int) -> list[_Outline]:
    """The state with each of these."""
    samples = state.scene.model.samples
    return side_by_side(lambda k: state.plus(kept[k]).outline, len(kept), cores, samples)


def a_joint(acting: Sequence[Bools]) -> float:
    """How many terms a joint has on average, of those that have any; `acting` (J,) of each term."""
    count = np.sum(acting, axis=0)
    return float(count[count > 0].mean())


@attrs.frozen(eq=False)
class _State:
    """Picks, and the scene of the model fitted beside them."""

    picks: tuple[Pick, ...]
    scene: Scene

    @cached_property
    def beside(self) -> Together:
        """The picks as they are fitted to what the scene leaves, its model staying as it is."""
        return Together(self.picks, self.scene, free=False)

    @cached_property
    def freed(self) -> Together:
        """The picks fitted together with the model, along its slopes."""
        return Together(self.picks, self.scene)

    @property
    def left(self) -> float:
        """Mean squared error of the rows that judge, N^2 m^2."""
        rows = self.scene.judge.judge
        return float(np.sum((self.beside.left * rows) ** 2) / max(int(rows.sum()), 1))

    @property
    def outline(self) -> _Outline:
        """All that is needed to make it again."""
        return _Outline(self.picks, self.scene.model, self.left)

    def plus(self, picks: Picks) -> _State:
        """With more picks, the model fitted anew; with these on all joints, where that says far more."""
        found = _State((*self.picks, *picks), self.scene).settled()
        if (wider := _wider(picks)) is None:
            return found
        wide = _State((*self.picks, wider), self.scene).settled()
        return wide if wide.left < _FAR_LESS * found.left else found

    def released(self) -> _State:
        """With gains that are held left free, if they then stay near those commanded."""
        model = self.scene.model
        if not model.gains_held:
            return self
        free = attrs.evolve(model, gains_held=False)
        found = _State(self.picks, Scene(free, self.scene.judge)).settled()
        return found if found.scene.model.believable else self

    def settled(self) -> _State:
        """With the model fitted beside the picks, and both together."""
        judge, best = self.scene.judge, self
        least = best.beside.error
        for _ in range(_STEPS):
            error = least
            for moved in best._steps():
                tried = _State(self.picks, Scene(moved, judge))
                if tried.beside.error < least:
                    least, best = tried.beside.error, tried
                    break
            if least > error * (1.0 - _SETTLED):
                break
        return best

    def _steps(self) -> Iterator[Model]:
        """The model after steps of less and less courage, the last one with its delays as they are."""
        joint, model, slots = self.freed, self.scene.model, self.scene.slots
        theta = np.concatenate([pack(model), model.input_delay[None], model.output_delay[None]])
        held = np.isin(np.arange(slots.count), slots.index[-2:])
        still = np.where(held | held[:, None], np.diag(np.diagonal(joint.hessian)), joint.hessian)
        tries = [(joint.hessian, joint.gradient, damping) for damping in _DAMPINGS]
        for hessian, gradient, damping in (
            *tries,
            (still, np.where(held, 0.0, joint.gradient), _DAMPINGS[0]),
        ):
            after = step(slots, theta, hessian, gradient, damping)
            yield with_slots(model, after[:-2]).with_delays(*np.round(after[-2:], 7))


@attrs.frozen(eq=False)
class _Outline:
    """A state without its scene, which is large."""

    picks: tuple[Pick, ...]
    model: Model
    left: float

    @property
    def size(self) -> tuple[int, int]:
        """How much the latest pick says."""
        return self.picks[-1].feature.size

    def state(self, judge: Judge) -> _State:
        """The state again."""
        return _State(self.picks, Scene(self.model, judge))


def _promising(state: _State, kept: Sequence[Picks], noise: Array, cores: int) -> list[Picks]:
    """What pays beside the picks of a state, best first: of what did before, or of everything where that does no more."""
    left = state.freed.left if state.picks else state.scene.residual
    fresh = [one for picks in kept for one in picks if one.feature.signal != "t"]
    found = _paying(_again(fresh, state.scene, left), state, noise) if fresh else []
    return found or _paying(library(state.scene, left), state, noise, cores)


def _wider(picks: Picks) -> Pick | None:
    """On all joints, what is on most of them: on the others, gains that it bends may stand for it."""
    one = picks[0]
    if (
        len(picks) > 1
        or one.joints.all()
        or one.feature.family is not None
        or one.joints.mean() < _MOST_JOINTS
    ):
        return None
    return attrs.evolve(one, joints=np.ones_like(one.joints))


def leanings(model: Model, judge: Judge) -> tuple[str, ...]:
    """The signals that what `model` leaves goes with most clearly, whether or not a term of them would pay."""
    scene = Scene(model, judge)
    trial, every = Trial((), scene), np.ones(len(scene.joints), dtype=bool)
    best: tuple[str, ...] = ()
    least = 1.0
    for feature in library(scene, scene.residual):
        p = trial.compare(feature, every).p_any
        if p < least:
            best, least = feature.key, p
    return best


def _again(kept: Sequence[Pick], scene: Scene, left: Array) -> Iterator[Feature]:
    yield from (one.feature for one in kept)
    yield from lines(scene, left)


def _paying(features: Iterable[Feature], state: _State, noise: Array, cores: int = 1) -> list[Picks]:
    """Those that pay beside the picks of a state, of the same signals the best one, and sets of neighbours; best first."""
    trial, every, samples = Trial(state.picks, state.scene), list(features), state.scene.model.samples
    best: dict[tuple[str, ...], Pick] = {}
    neighbours: dict[Any, list[Pick]] = {}
    parts = side_by_side(
        lambda k: [_pick(one, trial, noise) for one in every[k * _PART : (k + 1) * _PART]],
        -(-len(every) // _PART),
        cores,
        samples,
    )
    for pick in (one for part in parts for one in part if one is not None):
        feature = pick.feature
        before = best.get(feature.key)
        if before is None or pick.gain > before.gain:
            best[feature.key] = pick
        if feature.family is not None:
            neighbours.setdefault(feature.family, []).append(pick)
    most = sorted(best.values(), key=lambda one: -one.gain)[:_KEPT]
    tuned = side_by_side(lambda k: _tuned(most[k], trial, noise), len(most), cores, samples)
    found = [(one,) for one in tuned]
    sets = [each for picks in neighbours.values() if len(each := _own_neighbours(picks)) > 1]
    return sorted([*found, *sets], key=lambda one: -sum(pick.gain for pick in one))


def _own_neighbours(picks: Sequence[Pick]) -> Picks:
    """Every joint with the neighbour of its own that says most of it."""
    owner = np.argmax([one.each for one in picks], axis=0)
    found = []
    for k, one in enumerate(picks):
        mine = one.joints & (owner == k)
        if mine.any():
            found.append(attrs.evolve(one, joints=mine, each=one.each * mine))
    return tuple(found)


def _pick(feature: Feature, trial: Trial, noise: Array) -> Pick | None:
    """The feature on the joints where it pays; None where there are none."""
    promising = trial.promising(feature, noise)
    if not promising.any():
        return None
    found = trial.compare(feature, promising)
    taken = (found.p_joints * _TRIED * len(noise) < LEVEL) & (found.joint_gain > WORTH * noise)
    owner = feature.signal.rpartition("/")[0]
    taken &= np.array([name != owner for name in trial.scene.joints])
    each = found.fall.sum(axis=0) * taken / max(found.rows.sum(), 1)
    return Pick(feature, taken, each) if taken.any() else None


def _tuned(pick: Pick, trial: Trial, noise: Array) -> Pick:
    """The pick at the place and with the time constant, frequency or damping with which it says most of the fitted rows."""

    def error(feature: Feature) -> float:
        return trial.error(feature, pick.joints)

    best, least = pick.feature, error(pick.feature)
    if best.movable:
        moved = attrs.evolve(best, at=DRIVE if best.at == JOINT else JOINT)
        if (other := error(moved)) < least:
            best, least = moved, other
    for size in _TUNING:
        for shape in _near(best.shape, size):
            tried = attrs.evolve(best, shape=shape)
            if (other := error(tried)) < least:
                best, least = tried, other
    found = _pick(best, trial, noise)
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


def _simplest(states: Sequence[_Outline], before: float) -> _Outline:
    """Of those that gain nearly as much as the best one those of fewest signals; of these, as good, that of fewest numbers."""
    most = before - min(one.left for one in states)
    good = [one for one in states if before - one.left >= _AS_GOOD * most]
    fewest = min(one.size[0] for one in good)
    alike = [one for one in good if one.size[0] == fewest]
    least = min(one.left for one in alike)
    return min((one for one in alike if one.left <= _NEARLY * least), key=lambda one: (one.size, one.left))


def _pruned(state: _State, noise: Array) -> _State:
    """Without the picks that the others made needless."""
    picks, scene = state.picks, state.scene
    while len(picks) > 1:
        whole = Together(picks, scene).left
        losses = []
        for k in range(len(picks)):
            less = Together(picks[:k] + picks[k + 1 :], scene).left
            found = scene.judge.compare(less, whole)
            on = picks[k].joints
            worth = float(np.max(np.where(on, found.joint_gain / noise, 0.0)))
            losses.append((worth if float(found.p_joints[on].min()) * _TRIED < LEVEL else 0.0, k))
        worst, k = min(losses)
        if worst > WORTH:
            break
        picks = picks[:k] + picks[k + 1 :]
    return state if len(picks) == len(state.picks) else _State(picks, scene).settled()


def _narrowed(state: _State, noise: Array) -> _State:
    """Without the picks on joints that do without them, the model staying as it is."""
    picks = []
    for k, one in enumerate(state.picks):
        less = Together(state.picks[:k] + state.picks[k + 1 :], state.scene, free=False).left
        found = state.scene.judge.compare(less, state.beside.left)
        needed = one.joints & (found.joint_gain > WORTH * noise)
        if needed.any():
            picks.append(attrs.evolve(one, joints=needed))
    before = [one.joints.sum() for one in state.picks]
    same = [one.joints.sum() for one in picks] == before
    return state if same else _State(tuple(picks), state.scene).settled()


def _as_terms(state: _State) -> Learned:
    scene, joint, terms, parts = state.scene, state.beside, [], []
    for pick, weights, torque in zip(state.picks, joint.weights, joint.parts, strict=True):
        bound = np.max(np.abs(torque) * scene.judge.fit, axis=0)
        feature = pick.feature
        terms.append(
            Term(feature.signal, feature.times, feature.shape, pick.joints, weights, bound, feature.at)
        )
        parts.append(np.clip(torque, -bound, bound))
    total: Array = np.sum(parts, axis=0)
    left = scene.residual - total
    gains = [scene.judge.compare(left + part, left).gain for part in parts]
    return Learned(scene.model, tuple(terms), total, tuple(gains), columns_of(state.picks, scene))
