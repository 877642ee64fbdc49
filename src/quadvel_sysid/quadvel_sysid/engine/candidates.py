"""One candidate effect: where to start from, the joint fit with gains and delays, and the joints that it acts on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import attrs
import numpy as np

from quadvel_actuator.effects import EffectLaw
from quadvel_actuator.effects.commands import CommandHold

from .ahead import side_by_side
from .backlog import backlog, suspicious
from .delays import fit_with_delays
from .eam import WINDOWS
from .few import Few, remembers
from .judging import Judge
from .model import Applied, Model, fit
from .screening import Ground, Started, divided, later, start
from .signals import Array, Bools, Samples

_STEPS, _LAST_STEPS, _ON_ALL = 6, 3, 2
_LATER = tuple(np.arange(-0.003, 0.0031, 0.0005))
"""s: commands that step make an error of many small valleys along the delays"""

_JOINT_LEVEL = 0.01  # p-value below which a joint counts as acted on


def _may_move(model: Model) -> bool:
    """Is it worth the time to fit the last effect from other delays, too? With a memory, if it looks like a delay."""
    return not remembers(model) or model.applied[-1].law.shifts


def _best(models: Sequence[Model], rows: Bools, count: int) -> list[Model]:
    """The `count` models with the least errors."""
    return sorted(models, key=lambda one: one.error(rows))[:count]


@attrs.frozen(eq=False)
class Candidate:
    """A law fitted on top of a model, and what that is worth on the rows that judge."""

    law: EffectLaw
    model: Model
    residual: Array  # (N, J)
    gain: float  # mean fall of the squared error over all judged rows, N^2 m^2
    p: float
    joint_gain: Array  # (J,) mean fall over the joint's own rows

    @property
    def name(self) -> str:
        return self.law.name

    @property
    def joints(self) -> Bools:
        return self.model.applied[-1].active


@attrs.frozen(eq=False)
class Rest:
    """A model without one of its laws, and what the `rows` (N, J) of its residual say of that one."""

    model: Model
    rows: Bools

    @property
    def samples(self) -> Samples:
        return self.model.samples

    def strongest_neighbours(self) -> tuple[str, ...]:
        """For each joint another joint's q, dq or tau that its residual goes with; none of one joint.

        What the joint's own signals explain linearly is taken out first.
        """
        joints = self.samples.joints
        if len(joints) < 2:
            return ()
        s, torque = self.model.signals, self.model.predict()
        names = [f"{joint}/{signal}" for signal in ("q", "dq", "tau") for joint in joints]
        others = np.concatenate([s.q, s.dq, torque], axis=1)
        found = []
        for j in range(len(joints)):
            keep = self.rows[:, j]
            own = np.column_stack([np.ones(keep.sum()), s.q[keep, j], s.dq[keep, j], s.q_des[keep, j]])
            basis, _ = np.linalg.qr(own)
            left = others[keep] - basis @ (basis.T @ others[keep])
            score = (left.T @ (self.samples.tau - torque)[keep, j]) ** 2
            score /= np.einsum("nk,nk->k", left, left) + 1e-12
            score[j :: len(joints)] = -1.0
            found.append(names[int(np.argmax(score))])
        return tuple(found)


class About:
    """What a law may ask of the model that it is to be added to."""

    def __init__(self, model: Model, judge: Judge, noise: Array, few: Few, cores: int = 1) -> None:
        self.model, self.judge, self.noise, self.few, self.cores = model, judge, noise, few, cores
        self.samples, self.signals = model.samples, model.signals
        self.residual = np.where(judge.fit | judge.judge, self.samples.tau - model.predict(), 0.0)
        self.left = np.sum(np.where(judge.fit, self.residual, 0.0) ** 2, axis=0) / noise
        """squared error (J,) of the fitted rows, each joint's in units of its noise"""
        self.ground = Ground(model, few, self.left)
        start = self.ground.bases[-1]
        self.seen, self.torque = start.signals, start.predict()
        self.fitted = np.where(judge.fit, self.samples.tau - self.torque, 0.0)

    def kept(self, one: Candidate) -> float:
        """What a candidate takes off the squared error, in units of the noise, as a promise counts it."""
        fall = np.maximum(one.joint_gain, 0.0) / self.noise
        return float((fall * self.few.fitted_rows).sum())

    def fit(self, model: Model) -> Model:
        """The model fitted with its delays to few rows, from these or those without its last effect."""
        there, rows = self.few.of(model)
        here = there.with_delays(self.model.input_delay, self.model.output_delay)
        starts = (there, here) if _may_move(model) else (there,)
        near = _best([fit_with_delays(fit(one, rows, 2), rows, _STEPS) for one in starts], rows, 1)[0]
        near = attrs.evolve(near, samples=model.samples)
        if model.applied[
            -1
        ].law.shifts:  # commands that step make small valleys, which few rows cannot tell apart
            near = fit_with_delays(near, self.judge.fit, _ON_ALL)
        return near

    def fit_anew(self, model: Model) -> Model:
        """The model fitted from other delays and with other steps of the drive: an effect may have hidden the right ones."""
        some, rows = self.few.of(model)
        windows = [attrs.evolve(some, window=one) for one in sorted({model.window, *WINDOWS})]
        near = _LATER if _may_move(model) else ()

        def settled(k: int) -> list[Model]:
            """Of one window: each has its own valleys, so that they are compared at the bottom."""
            starts = (*divided(windows[k]), *later(windows[k], near))
            best = _best([fit(at, rows, 2) for at in starts], rows, 2)
            return [fit_with_delays(one, rows, 2 * _STEPS) for one in best]

        of_each = side_by_side(settled, len(windows), self.cores, some.samples)
        best = _best([one for found in of_each for one in found], rows, 2)
        whole = [attrs.evolve(one, samples=model.samples) for one in best]
        return _best([fit_with_delays(one, self.judge.fit, _LAST_STEPS) for one in whole], self.judge.fit, 1)[
            0
        ]

    def strongest_neighbours(self) -> tuple[str, ...]:
        return Rest(self.ground.bases[-1], self.judge.fit).strongest_neighbours()

    def lost_commands(self, most: int) -> list[tuple[Array, Array]]:
        """How likely the drive lags by 0 to `most` commands: at each row, (N, J, most + 1), and at any; none if it rarely does.

        For each joint without a look at the torque that it is judged by. Losses at random delay the commands by what they
        do so on average, which is in the delay of a model without them: earlier ones are looked at while that says more.
        """
        if len(self.noise) < 2 or not suspicious(self.model, self.noise, _LOST_SHARE):
            return []
        best, rows = self._with_losses(most), self.judge.fit
        if best is None or best.foretold().error(rows) > _FORETOLD * self.model.error(rows):
            return []
        return [self._backlog(best.without(len(best.applied) - 1), most)]

    def _with_losses(self, most: int) -> Model | None:
        """The best of the models that lose commands, from these delays and earlier ones; None if these lose hardly any."""
        least, best, in_vain = np.inf, None, 0
        for model in self._earlier():
            odds = self._backlog(model, most)
            if 1.0 - odds[1][0] < _LOST_SHARE:
                break
            losing = self._losing(model, odds)
            error = losing.error(self.judge.judge)  # the odds of which did not look at their torque
            if error < least:
                least, best, in_vain = error, losing, 0
            else:
                in_vain += 1
            if in_vain == _IN_VAIN or odds[1] @ np.arange(most + 1) < _EARLIER:
                break
        return best

    def _earlier(self) -> Iterator[Model]:
        """The model, and with input delays ever shorter, until there are none or it was looked at often enough."""
        step = _EARLIER * np.median(np.concatenate([np.diff(log.t_cmd) for log in self.samples.logs]))
        for turn in range(_TURNS):
            delay = np.maximum(self.model.input_delay - turn * step, 0.0)
            yield self.model.with_delays(delay, self.model.output_delay)
            if not delay.any():
                return

    def _losing(self, model: Model, odds: tuple[Array, Array]) -> Model:
        """The model with commands lost by these odds, fitted."""
        every = np.ones(len(self.noise), dtype=bool)
        lost = Applied(CommandHold(*odds), every, np.full((1, len(every)), 0.05), np.arange(len(every)))
        return fit_with_delays(model.plus(lost), self.judge.fit, 2)

    def _backlog(self, model: Model, most: int) -> tuple[Array, Array]:
        odds = backlog(model, self.noise, most, self.judge.judge)
        return odds, odds[self.judge.fit].mean(axis=0)


_LOST_SHARE = 0.003
"""Of the rows: commands are not looked at as lost where fewer lag behind."""

_EARLIER, _TURNS, _IN_VAIN = 0.2, 8, 2
"""of the time between two commands; how many such steps; and after how many in vain there are no more"""

_FORETOLD = 1.25
"""Times the error of the model without: losses at random leave, all alike, about what a longer delay left in their place.
Where much more is left than that, what was read off the torque as losses was something else."""


def started(about: About, law: EffectLaw) -> Started | None:
    """Where to fit the law from; None where it takes nothing off the error."""
    return start(about.ground, law, law.starts(about.seen, about.torque, about.fitted))


def propose(about: About, started: Started) -> Candidate | None:
    """The law fitted to all joints, and then to those that it acts on; None where that takes a joint it has not."""
    law, grown = started.law, started.model
    if law.gainlike:
        fewer = _without_weakest(about.fit(grown))
        if fewer is None:
            return None
        grown = fewer
    grown = about.fit(grown)
    everywhere = judged(about, law, grown)
    chosen = _acted_on(about, everywhere)
    if chosen.all() or not chosen.any():
        return everywhere
    some = attrs.evolve(grown.applied[-1], active=chosen)
    few = judged(about, law, about.fit(attrs.evolve(grown, applied=(*grown.applied[:-1], some))))
    return few if few.gain >= 0.98 * everywhere.gain else everywhere


def anew(about: About, one: Candidate) -> Candidate:
    """The candidate fitted from other delays, too."""
    found = judged(about, one.law, about.fit_anew(one.model))
    return found if found.gain > one.gain else one


def simplified(about: About, one: Candidate) -> Candidate | None:
    """The simpler law that the candidate's can become, fitted from where the candidate is; None where there is none."""
    less = less_said(one.model.applied[-1])
    if less is None:
        return None
    model = attrs.evolve(one.model, applied=(*one.model.applied[:-1], less))
    return judged(about, less.law, about.fit(model))


def less_said(applied: Applied) -> Applied | None:
    """The simpler law that this one can become, on the same joints; None where there is none."""
    found = applied.law.simpler(dict(zip(applied.law.names, applied.values, strict=True)))
    if found is None:
        return None
    law, start = found
    return attrs.evolve(applied, law=law, values=np.array([start[name] for name in law.names]))


def _without_weakest(model: Model) -> Model | None:
    """The last effect off the joint where it is weakest, which gains or delays then stand for; None of one joint."""
    last = model.applied[-1]
    if last.active.sum() < 2:
        return None
    active = last.active & (np.arange(len(last.active)) != np.argmin(np.abs(last.values[0])))
    return attrs.evolve(model, applied=(*model.applied[:-1], attrs.evolve(last, active=active)))


def best_form(about: About, law: type[EffectLaw], least: float) -> Candidate | None:
    """The most promising form of a law of the registry, fitted; None where none promises so much."""
    forms = [one for form in law.variants(about) if (one := started(about, form)) is not None]
    best = max(forms, key=lambda one: one.promise, default=None)
    return None if best is None or best.promise < least else propose(about, best)


def judged(about: About, law: EffectLaw, model: Model) -> Candidate:
    """The law, last in the model, with what it is worth."""
    residual = about.samples.tau - model.predict()
    found = about.judge.compare(about.residual, residual)
    return Candidate(law, model, residual, found.gain, found.p_any, found.joint_gain)


def _acted_on(about: About, candidate: Candidate) -> Bools:
    """The joints that would be predicted worse without the effect, everything else staying as it is."""
    idle = candidate.model.without(len(candidate.model.applied) - 1)
    found = about.judge.compare(about.samples.tau - idle.predict(), candidate.residual)
    chosen: Bools = (found.p_joints < _JOINT_LEVEL) & (found.joint_gain > 0.02 * about.noise)
    return chosen
