"""What no named effect explains: readable terms of named signals, taken while held-out rows say that they pay.

A term is a smooth function of one signal (also times the direction of motion, or times the torque), a short linear
filter of one signal's history, a resonance that a signal excites, or lines of a spectrum in time. Each is bounded:
outside the range that the log covers a smooth function stays at its end.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

import attrs
import numpy as np
from scipy.interpolate import BSpline
from scipy.signal import lfilter

from .judging import Judge
from .model import Model
from .signals import Array, Bools

LEVEL = 0.01
"""A term is taken if chance would bring its gain with less than this probability, all that were tried counted."""

WORTH = 0.03
"""Least gain on a joint, as a share of its noise."""

MOST = 8
"""Terms at most."""

_KEPT = 10  # inputs that come into question after the first look
_RIDGE = 1e-5
_TRIED = 60  # bases a joint that count as independent trials
_HISTORY = 0.02  # s
_FREQUENCIES = np.geomspace(3.0, 110.0, 26)  # Hz
_DAMPING = (0.02, 0.07, 0.2)


@attrs.frozen(eq=False)
class Basis:
    """Columns (N, K), or (N, K, J) where every joint has its own, that a term is a sum of; `inputs` in the joint's words."""

    inputs: tuple[str, ...]
    kind: str
    columns: Array
    own: bool
    source: str = ""  # the joint that an absolute signal belongs to


@attrs.frozen(eq=False)
class Term:
    """A basis at work on some joints, with its torque (N, J)."""

    basis: Basis
    joints: Bools
    coefficients: Array  # (K, J)
    torque: Array
    gain: float  # over all judged rows
    p: float

    def inputs(self, joints: Sequence[str]) -> list[str]:
        """The signals as the report names them."""
        return list(self.basis.inputs)


@attrs.frozen(eq=False)
class Learned:
    """The terms that were taken."""

    terms: tuple[Term, ...]

    @property
    def torque(self) -> Array:
        """Of all terms, (N, J), N m."""
        total: Array = np.sum([term.torque for term in self.terms], axis=0)
        return total

    @property
    def joints(self) -> Bools:
        """Those on which any term acts."""
        acts: Bools = np.any([term.joints for term in self.terms], axis=0)
        return acts

    @property
    def inputs(self) -> list[str]:
        """All signals that the terms depend on, the weightiest first."""
        ranked = sorted(self.terms, key=lambda term: -term.gain)
        return list(dict.fromkeys(name for term in ranked for name in term.basis.inputs))


def learn(model: Model, judge: Judge, noise: Array) -> Learned | None:
    """Terms for what `model` leaves; None where nothing pays."""
    residual = model.residual(judge.fit | judge.judge)
    terms: list[Term] = []
    found = _taken(library(model, residual, judge), residual, judge, noise)
    while found and len(terms) < MOST:
        term = found[0]
        terms.append(term)
        residual = residual - term.torque * (judge.fit | judge.judge)
        bases = [one.basis for one in found if one.basis.kind != "line"]
        found = _taken([*bases, *_lines(model, residual, judge)], residual, judge, noise)
    return Learned(tuple(terms)) if terms else None


def library(model: Model, residual: Array, judge: Judge) -> Iterator[Basis]:
    """Every basis that is tried on the residual."""
    s, joints = model.signals, model.samples.joints
    asked = model.predict()
    own = {"q": s.q, "dq": s.dq, "ddq": s.ddq, "q_des": s.q_des, "tau": asked}
    direction = np.tanh(s.dq / 0.05)
    for name, u in own.items():
        yield Basis((name,), "smooth", _smooth(u, 9), True)
        if name in ("q", "tau"):
            yield Basis((name, "dq"), "friction", _smooth(u, 7) * direction[:, None], True)
        if name in ("q", "dq"):
            yield Basis((name, "tau"), "gain", _smooth(u, 6) * asked[:, None], True)
    yield Basis(("q",), "fine", _smooth(s.q, 28), True)
    yield Basis(("q_des", "q"), "smooth", _smooth(s.q_des - s.q, 9), True)
    clock = model.samples.t[:, None] - model.samples.t.min()
    yield Basis(("t",), "smooth", _smooth(clock, 10)[:, :, 0], False)
    yield Basis(("t", "tau"), "gain", _smooth(clock, 6) * asked[:, None], True)
    for name, u in (("tau", asked), ("q_des", s.q_des), ("q", s.q), ("dq", s.dq)):
        yield Basis((f"{name}@history",), "filter", _taps(u, model), True)
    for name, u in (("tau", asked), ("q", s.q)):
        yield from (Basis((f"{name}@history",), "resonance", one, True) for one in _resonances(u, model))
    others = {"q": s.q, "dq": s.dq, "tau": s.measured}
    for k, joint in enumerate(joints if len(joints) > 1 else ()):
        for name, u in others.items():
            label = f"{joint}/{name}"
            plain = _smooth(u[:, k : k + 1], 9)
            yield Basis((label,), "smooth", plain[:, :, 0], False, joint)
            if name == "q":
                yield Basis((label,), "fine", _smooth(u[:, k : k + 1], 28)[:, :, 0], False, joint)
            yield Basis((label, "dq"), "friction", plain[:, ::2] * direction[:, None], True, joint)
            yield Basis((label, "tau"), "gain", plain[:, ::2] * asked[:, None], True, joint)
    yield from _lines(model, residual, judge)


def _smooth(u: Array, count: int) -> Array:
    """Cubic B-splines over the range of each column of `u` (N, C), as (N, count, C)."""
    low, high = np.quantile(u, 0.005, axis=0), np.quantile(u, 0.995, axis=0)
    knots = np.linspace(0.0, 1.0, count - 2)
    padded = np.concatenate([np.zeros(3), knots, np.ones(3)])
    out = np.empty((len(u), count, u.shape[1]))
    for c in range(u.shape[1]):
        x = np.clip((u[:, c] - low[c]) / max(high[c] - low[c], 1e-9), 0.0, 1.0 - 1e-9)
        out[:, :, c] = BSpline.design_matrix(x, padded, 3).toarray()
    return out


def _taps(u: Array, model: Model) -> Array:
    """Means of `u` over growing stretches of its past, up to _HISTORY, less its present value, (N, K, J)."""
    rows = max(round(_HISTORY / model.samples.period), 4)
    edges = np.unique(np.round(np.geomspace(1, rows, 7)).astype(int))
    sums = np.concatenate([np.zeros((1, u.shape[1])), np.cumsum(u, axis=0)])
    n = np.arange(len(u))
    columns = [u]
    for near, far in pairwise(edges):
        a, b = np.maximum(n - far + 1, 0), np.maximum(n - near + 1, 1)
        columns.append((sums[b] - sums[a]) / np.maximum(b - a, 1)[:, None] - u)
    return np.stack(columns, axis=1)


def _resonances(u: Array, model: Model) -> Iterator[Array]:
    """What damped resonances make of `u`: place and speed of each, (N, 2, J)."""
    dt = model.samples.period
    centred = u - u.mean(axis=0)
    for frequency in _FREQUENCIES:
        if frequency > 0.35 / dt:
            continue
        for damping in _DAMPING:
            pole = np.exp(2.0 * np.pi * frequency * dt * (-damping + 1j * np.sqrt(1.0 - damping**2)))
            answer = lfilter([1.0 - abs(pole)], [1.0, -2.0 * pole.real, abs(pole) ** 2], centred, axis=0)
            yield np.stack([answer, np.gradient(answer, axis=0)], axis=1)


def _lines(model: Model, residual: Array, judge: Judge) -> Iterator[Basis]:
    """The strongest lines of the residual's spectrum in time, each with two overtones."""
    t = model.samples.t - model.samples.t.min()
    span = float(np.ptp(t))
    step = 0.5 / span
    top = 0.45 / model.samples.period
    grid = np.arange(max(2.0, 3.0 / span), top, step)
    even = np.arange(0.0, span, model.samples.period)
    power = np.zeros(len(grid))
    fitted = np.where(judge.fit, residual, 0.0)
    for j in range(residual.shape[1]):
        spectrum = np.fft.rfft(np.interp(even, t, fitted[:, j]), 2 * len(even))
        frequencies = np.fft.rfftfreq(2 * len(even), model.samples.period)
        power = np.maximum(power, np.interp(grid, frequencies, np.abs(spectrum)))
    for best in np.argsort(-power)[:3]:
        frequency = _peak(grid[best], step, t, fitted)
        angles = 2.0 * np.pi * frequency * np.outer(t, [1.0, 2.0, 3.0])
        yield Basis(("t",), "line", np.concatenate([np.sin(angles), np.cos(angles)], axis=1), False)


def _peak(frequency: float, step: float, t: Array, residual: Array) -> float:
    """The frequency near by at which the line is strongest."""
    near = frequency + np.linspace(-step, step, 21)
    waves = np.exp(-2j * np.pi * np.outer(near, t))
    return float(near[int(np.argmax((np.abs(waves @ residual) ** 2).sum(axis=1)))])


def _taken(bases: Iterable[Basis], residual: Array, judge: Judge, noise: Array) -> list[Term]:
    """The bases fitted on the joints where they are significant, of the same inputs the best one; the best _KEPT."""
    best: dict[tuple[str, ...], Term] = {}
    count = _TRIED * residual.shape[1]
    for basis in bases:
        torque, coefficients = _fitted(basis, residual, judge.fit)
        found = judge.compare(residual, residual - torque)
        gain, p = found.joint_gain, found.p_joints
        taken = (p * count < LEVEL) & (gain > WORTH * noise)
        if basis.source:
            taken &= np.array([name != basis.source for name in judge.joints])
        total = float((found.fall * taken).sum() / max(found.rows.sum(), 1))
        before = best.get(basis.inputs)
        if taken.any() and (before is None or total > before.gain):
            term = Term(basis, taken, coefficients * taken, torque * taken, total, float(p[taken].min()))
            ranked = sorted([*(best | {basis.inputs: term}).values()], key=lambda one: -one.gain)[:_KEPT]
            best = {one.basis.inputs: one for one in ranked}
    return sorted(best.values(), key=lambda one: -one.gain)


def _fitted(basis: Basis, residual: Array, rows: Bools) -> tuple[Array, Array]:
    """Least squares of the residual on the basis: torque (N, J) and coefficients (K, J)."""
    columns = basis.columns
    joints = residual.shape[1]
    coefficients = np.empty((columns.shape[1], joints))
    torque = np.empty_like(residual)
    alike: dict[bytes, list[int]] = {}
    for j in range(joints):
        alike.setdefault(rows[:, j].tobytes(), []).append(j)
    for members in alike.values():
        keep = rows[:, members[0]]
        for group in [members] if columns.ndim == 2 else [[j] for j in members]:
            x = columns if columns.ndim == 2 else columns[:, :, group[0]]
            inside = x[keep]
            gram = inside.T @ inside
            gram[np.diag_indices_from(gram)] += _RIDGE * np.trace(gram) / len(gram) + 1e-12
            solution = np.linalg.solve(gram, inside.T @ residual[keep][:, group])
            coefficients[:, group] = solution
            torque[:, group] = x @ solution
    return torque, coefficients
