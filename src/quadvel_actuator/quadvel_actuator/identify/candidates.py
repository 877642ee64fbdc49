"""One candidate effect: where to start from, the joint fit with gains and delays, and the joints that it acts on."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from ..effects import EffectLaw
from ..effects.commands import CommandHold
from .backlog import backlog
from .delays import fit_with_delays
from .judging import Judge
from .model import Applied, Model, fit
from .signals import Array, Bools

_BATCH = 8  # guesses evaluated at once
_GAIN_STEP = 0.01
_PROMISE = (
    0.01  # of the noise: a law that takes less off the fitted error of every joint is not tried further
)
_DELAY_MOVES = (
    (0.0, 0.0),
    (0.0, -0.001),
    (0.0, -0.002),
    (0.0, -0.004),
    (-0.002, 0.0),
    (-0.004, 0.0),
    (0.002, -0.002),
)
_JOINT_LEVEL = 0.01  # p-value below which a joint counts as acted on


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


class About:
    """What a law may ask of the model that it is to be added to."""

    def __init__(self, model: Model, judge: Judge, noise: Array) -> None:
        self.model, self.judge, self.noise = model, judge, noise
        self.samples, self.signals = model.samples, model.signals
        self.torque = model.predict()
        self.residual = np.where(judge.fit | judge.judge, self.samples.tau - self.torque, 0.0)
        self.fitted = np.where(judge.fit, self.residual, 0.0)

    def strongest_neighbour(self, names: Sequence[str]) -> NDArray[np.intp]:
        """For each joint the index (over names, then joints) of another joint's signal that its residual goes with.

        What the joint's own signals explain linearly is taken out first.
        """
        s, joints = self.signals, len(self.samples.joints)
        others = np.concatenate([getattr(s, name) for name in names], axis=1)
        found = np.zeros(joints, dtype=np.intp)
        for j in range(joints):
            keep = self.judge.fit[:, j]
            own = np.column_stack([np.ones(keep.sum()), s.q[keep, j], s.dq[keep, j], s.q_des[keep, j]])
            basis, _ = np.linalg.qr(own)
            left = others[keep] - basis @ (basis.T @ others[keep])
            r = self.fitted[keep, j]
            score = (left.T @ r) ** 2 / (np.einsum("nk,nk->k", left, left) + 1e-12)
            score[j::joints] = -1.0
            found[j] = int(np.argmax(score))
        return found

    def lost_commands(self, most: int) -> list[NDArray[np.intp]]:
        """By how many commands the drive seems to lag: (N, 1) for all joints together, (N, J) for each of them.

        Both are left out where next to nothing is lost.
        """
        found = []
        for together in (True, False):
            behind = backlog(self.model, self.noise, most, together)
            if _share(behind, self.model) > _LOST_SHARE:
                law = CommandHold(behind)
                share = np.full((1, len(self.noise)), 0.05)
                every = np.ones(len(self.noise), dtype=bool)
                better = fit_with_delays(
                    self.model.plus(Applied(law, every, share, np.arange(len(self.noise)))), self.judge.fit, 2
                )
                found.append(backlog(better.without(len(better.applied) - 1), self.noise, most, together))
        return found


_LOST_SHARE = 0.003


def _share(behind: NDArray[np.intp], model: Model) -> float:
    fresh = np.diff(model.signals.packet[:, 0], prepend=-1) > 0
    return float((behind[fresh] > 0).mean())


@attrs.frozen(eq=False)
class Started:
    """A law on a model at the best of its starts, only gains and linear parameters fitted."""

    law: EffectLaw
    model: Model
    promise: float
    """what it takes off the squared error of the fitted rows, each joint's in units of its noise"""


def propose(about: About, started: Started) -> Candidate | None:
    """The law fitted to all joints, and then to those that it acts on; None where that takes a joint it has not."""
    model, judge, law, grown = about.model, about.judge, started.law, started.model
    joints = np.arange(len(model.samples.joints))
    if law.gainlike:
        fewer = _without_weakest(fit(grown, judge.fit, 4))
        if fewer is None:
            return None
        grown = fewer
    grown = fit(grown, judge.fit, 4)
    if law.shifts:
        grown = fit_with_delays(grown, judge.fit)
    everywhere = _judged(about, law, grown)
    chosen = _acted_on(about, everywhere)
    if chosen.all() or not chosen.any():
        return everywhere
    some = attrs.evolve(grown.applied[-1], active=chosen, groups=joints)
    back = attrs.evolve(grown, applied=(*grown.applied[:-1], some))
    if law.shifts:  # the delays that the effect moved belong to the joints without it, too
        back = back.with_delays(model.input_delay, model.output_delay)
    back = fit_with_delays(back, judge.fit) if law.shifts else fit(back, judge.fit, 4)
    few = _judged(about, law, back)
    return few if few.gain >= 0.98 * everywhere.gain else everywhere


def _without_weakest(model: Model) -> Model | None:
    """The last effect off the joint where it is weakest, which its gain then stands for; None of one joint."""
    last = model.applied[-1]
    if last.active.sum() < 2:
        return None
    active = last.active & (np.arange(len(last.active)) != np.argmin(last.values[0]))
    return attrs.evolve(model, applied=(*model.applied[:-1], attrs.evolve(last, active=active)))


def _judged(about: About, law: EffectLaw, model: Model) -> Candidate:
    residual = about.samples.tau - model.predict()
    found = about.judge.compare(about.residual, residual)
    return Candidate(law, model, residual, found.gain, found.p_any, found.joint_gain)


def _acted_on(about: About, candidate: Candidate) -> Bools:
    """The joints that would be predicted worse without the effect, everything else staying as it is."""
    last = candidate.model.applied[-1]
    idle = candidate.model.without(len(candidate.model.applied) - 1)
    # with delays that moved, the model without the effect is the one before
    before = about.residual if last.law.shifts else about.samples.tau - idle.predict()
    found = about.judge.compare(before, candidate.residual)
    chosen: Bools = (found.p_joints < _JOINT_LEVEL) & (found.joint_gain > 0.02 * about.noise)
    return chosen


def start(about: About, law: EffectLaw) -> Started | None:
    """The law at the best of its starts, chosen for each joint on its own; None where that takes nothing off the error."""
    model, rows = about.model.reaching(about.judge.fit)
    starts = law.starts(about.signals, about.torque, about.fitted)
    if not starts:
        return None
    joints = len(model.samples.joints)
    table = np.array(
        [
            [
                np.broadcast_to(start.get(parameter.name, parameter.scale), joints).clip(
                    parameter.low, parameter.high
                )
                for parameter in law.parameters
            ]
            for start in starts
        ]
    )  # (starts, P, J)
    empty = Applied(law, np.ones(joints, dtype=bool), table[0], np.arange(joints))
    best: Model | None = None
    least, lowest, bare = np.inf, np.full(joints, np.inf), np.full(joints, np.inf)
    for move in _DELAY_MOVES if law.shifts else _DELAY_MOVES[:1]:
        at = _shifted(model, *move)
        if at is None:
            continue
        values, error, without = _screen(at.plus(empty), table, rows)
        bare = np.minimum(bare, without)
        if error.sum() < least * 0.999:
            least, lowest, best = float(error.sum()), error, at.plus(attrs.evolve(empty, values=values))
    promise = (bare - lowest) / about.noise
    if best is None or not (law.gainlike or (promise / np.maximum(rows.sum(axis=0), 1)).max() > _PROMISE):
        return None
    return Started(law, attrs.evolve(best, samples=about.samples), float(promise.sum()))


def _shifted(model: Model, by_input: float, by_output: float) -> Model | None:
    input_delay, output_delay = model.input_delay + by_input, model.output_delay + by_output
    if (input_delay < -1e-9).any() or (output_delay < -1e-9).any():
        return None
    return model.with_delays(np.clip(input_delay, 0.0, None), np.clip(output_delay, 0.0, None))


def _screen(model: Model, table: Array, rows: Bools) -> tuple[Array, Array, Array]:
    """The values (P, J) of each joint's best start, gains and linear parameters free; the error (J,) then and without.

    `table` (starts, P, J) are the values of the model's last effect.
    """
    law, others = model.applied[-1].law, model.applied[:-1]
    linear = [law.names.index(name) for name in getattr(law, "linear", ())]
    at_zero = table.copy()
    at_zero[:, linear] = 0.0
    moved = np.repeat(model.gains[None], 3, axis=0)
    moved[1, 0] += _GAIN_STEP
    moved[2, 1] += _GAIN_STEP

    def run(values: Array, gains: Array) -> Array:
        return model.evaluate(
            gains, [*(np.repeat(o.values[None], len(values), axis=0) for o in others), values]
        )

    def with_gains(values: Array) -> tuple[Array, list[Array]]:
        """Torque of each start (B, N, J), and its slopes along the gains."""
        torque = run(np.repeat(values, 3, axis=0), np.tile(moved, (len(values), 1, 1)))
        return torque[::3], [(torque[k::3] - torque[::3]) / _GAIN_STEP for k in (1, 2)]

    found = []
    for first in range(0, len(table), _BATCH):
        part = at_zero[first : first + _BATCH]
        base, slopes = with_gains(part[:1] if linear else part)
        columns = []
        for one in linear:
            unit = part.copy()
            unit[:, one] = 1.0
            columns.append(run(unit, np.repeat(model.gains[None], len(unit), axis=0)) - base)
        found.append(_regress(model.samples.tau - base, columns + slopes, rows))
    error, solution = (np.concatenate(part) for part in zip(*found, strict=True))
    best = np.argmin(error, axis=0)
    joint = np.arange(table.shape[2])
    values = table[best, :, joint].T.copy()
    for k, one in enumerate(linear):
        values[one] = np.clip(solution[best, joint, k], law.parameters[one].low, law.parameters[one].high)
    torque = attrs.evolve(model, applied=others).evaluate(
        moved, [np.repeat(o.values[None], 3, axis=0) for o in others]
    )
    slopes = [(torque[k : k + 1] - torque[:1]) / _GAIN_STEP for k in (1, 2)]
    without, _ = _regress(model.samples.tau - torque[:1], slopes, rows)
    return values, error[best, joint], without[0]


def _regress(y: Array, columns: list[Array], rows: Bools) -> tuple[Array, Array]:
    """Least squares of y (B or 1, N, J) on columns: sum of squares (B, J) and solution (B, J, K)."""
    count = max(len(y), *(len(one) for one in columns))
    shape = (count, *rows.shape)
    wide = np.stack([np.broadcast_to(one, shape) for one in columns])  # (K, B, N, J)
    wide = np.ascontiguousarray(wide.transpose(1, 3, 0, 2)) * rows.T[None, :, None]  # (B, J, K, N)
    target = np.broadcast_to(y * rows, shape).transpose(0, 2, 1)  # (B, J, N)
    gram = wide @ wide.transpose(0, 1, 3, 2)
    size = np.einsum("bjkk->bjk", gram)
    gram = gram + np.eye(gram.shape[-1]) * (1e-8 * size[..., None] + 1e-12)
    right = np.einsum("bjkn,bjn->bjk", wide, target)
    solution = np.linalg.solve(gram, right[..., None])[..., 0]
    error = np.einsum("bjn,bjn->bj", target, target) - np.einsum("bjk,bjk->bj", solution, right)
    return error, solution
