"""The empirical actuator model as the paper identifies it (Section 3.1), with delays below a millisecond.

For every pair of delays on a fine grid the gains follow by linear regression; the pairs whose error is below 1.5
times the least one are kept, and the noise is the least error. The cross products that the regressions need are
summed once for each delay, not once for each pair, which is what makes the grid cheap.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.parameters import PROBABLE, DelayPair

from .signals import Array, Bools, Samples, scattered

LONGEST_INPUT, LONGEST_OUTPUT = 0.020, 0.006  # s
WINDOWS = (0.0, 0.001)
"""s, steps that a drive may have"""

_REFINEMENTS = ((0.00075, 0.00025), (0.0002, 0.00005))  # s: reach about the best pair so far, step
_ENOUGH = 1500  # rows for the first, coarse look
_CHUNK = 20000  # rows summed at once


@attrs.frozen(eq=False)
class Eam:
    """Gains and delays of all joints together, or of each (J,)."""

    gains: Array
    """(2, J): real over commanded kp and kd"""
    input_delay: Array
    """(J,) s"""
    output_delay: Array
    """(J,) s"""
    window: float
    """the drive's step, s: commands are means over it"""
    mse: float
    """over the rows that were fitted, N^2 m^2"""
    pairs: tuple[DelayPair, ...] = ()
    """the probable pairs, the best one first"""

    def predict(self, samples: Samples) -> Array:
        """Torque of every row, (N, J), N m."""
        return pd_torque(samples, self.gains, self.input_delay, self.output_delay, self.window)


def pd_torque(
    samples: Samples, gains: Array, input_delay: Array | float, output_delay: Array | float, window: float
) -> Array:
    """Eq. 1 without its noise, (N, J), N m."""
    s = samples.at(input_delay, output_delay, window)
    torque: Array = gains[0] * s.pull + gains[1] * s.drag + s.tau_ff
    return torque


class _Sums:
    """Cross products of the shifted commands and states, so that any pair's regression is a 2 by 2 system.

    The torque is g0 (C - Q) + g1 (D - V) + F with C = kp q_des, D = kd dq_des, F = tau_ff shifted by the sum of both
    delays, Q = kp q and V = kd dq shifted by the output delay. A delay index `i` is a sum, `o` an output delay.
    """

    def __init__(
        self, samples: Samples, rows: Bools, totals: Array, outputs: Array, window: float, at: float
    ):
        j = len(samples.joints)
        shape = (j, len(totals), len(outputs))
        self.aa, self.ab, self.bb, self.ay, self.by, self.yy = (np.zeros(shape) for _ in range(6))
        self.count = rows.sum(axis=0)
        offset = 0
        for one in samples.logs:
            t = np.asarray(one.log.t, dtype=float)
            for first in range(0, len(t), _CHUNK):
                part = slice(first, min(first + _CHUNK, len(t)))
                here = slice(offset + part.start, offset + part.stop)
                if rows[here].any():
                    self._add(one, t[part], samples.tau[here], rows[here], totals, outputs, window, at)
            offset += len(t)

    def _add(
        self,
        one: Any,
        t: Array,
        tau: Array,
        rows: Bools,
        totals: Array,
        outputs: Array,
        window: float,
        at: float,
    ) -> None:
        packet = one.log.command_rows(t - at)
        keep = rows.T[:, None].astype(float)  # (J, 1, N), like all below: joint, delay, row
        kp, kd = (one.gains[name][packet].T[:, None] * keep for name in ("kp", "kd"))
        y = tau.T[:, None] * keep
        c = _stack(one.command("q_des", t - d, window) for d in totals) * kp
        q = _stack(one.state("q", t - d) for d in outputs) * kp
        v = _stack(one.state("dq", t - d) for d in outputs) * kd
        self.aa += _norm(c)[..., None] - 2 * _cross(c, q) + _norm(q)[:, None]
        self.ab += np.einsum("jon,jon->jo", q, v)[:, None] - _cross(c, v)
        self.bb += _norm(v)[:, None]
        self.ay += _cross(c, y) - _cross(y, q)
        self.by -= _cross(y, v)
        self.yy += _norm(y)[..., None]
        if not {"dq_des", "tau_ff"} & set(one.sums):
            return
        w = _stack(one.command("dq_des", t - d, window) for d in totals) * kd
        f = _stack(one.command("tau_ff", t - d, window) for d in totals) * keep
        self.ab += np.einsum("jdn,jdn->jd", c, w)[..., None] - _cross(w, q)
        self.bb += _norm(w)[..., None] - 2 * _cross(w, v)
        self.ay -= np.einsum("jdn,jdn->jd", c, f)[..., None] - _cross(f, q)
        self.by += _cross(w, y) - np.einsum("jdn,jdn->jd", w, f)[..., None] + _cross(f, v)
        self.yy += (_norm(f) - 2 * _cross(f, y)[..., 0])[..., None]

    def solve(self, groups: NDArray[np.intp]) -> tuple[Array, Array, Array]:
        """Mean squared error (G, T, O) of each group of joints and pair, and the two gains."""
        count = int(groups.max()) + 1
        aa, ab, bb, ay, by, yy = (
            np.stack([term[groups == g].sum(axis=0) for g in range(count)])
            for term in (self.aa, self.ab, self.bb, self.ay, self.by, self.yy)
        )
        n = np.array([self.count[groups == g].sum() for g in range(count)])[:, None, None]
        det = aa * bb - ab * ab
        ridge = 1e-12 * (aa + bb) ** 2 + 1e-300
        g0 = np.where(det > ridge, (bb * ay - ab * by) / np.maximum(det, ridge), ay / np.maximum(aa, 1e-300))
        g1 = np.where(det > ridge, (aa * by - ab * ay) / np.maximum(det, ridge), 0.0)
        mse = (yy - g0 * ay - g1 * by) / np.maximum(n, 1)
        return np.maximum(mse, 0.0), g0, g1


def fit_eam(
    samples: Samples,
    rows: Bools,
    groups: NDArray[np.intp] | None = None,
    windows: Sequence[float] = WINDOWS,
) -> Eam:
    """Fit the EAM to `rows` (N, J); joints with the same number in `groups` (J,) share gains and delays.

    All joints share them by default, as the paper has it. The drive's step is the first of `windows` (s) unless a
    later one fits better.
    """
    groups = np.zeros(len(samples.joints), dtype=int) if groups is None else groups
    thinned = np.zeros_like(rows)
    some = scattered(len(rows), max(1, len(rows) // _ENOUGH))
    thinned[some] = rows[some]
    found = []
    for window in windows:
        totals = np.arange(0.0, LONGEST_INPUT + LONGEST_OUTPUT + 1e-9, 0.001)
        eam = _search(
            samples, thinned, groups, window, totals, np.arange(0.0, LONGEST_OUTPUT + 1e-9, 0.001), 0.0
        )
        for reach, step in _REFINEMENTS:
            total, output = eam.input_delay + eam.output_delay, eam.output_delay
            totals = _around(total, reach, step, LONGEST_INPUT + LONGEST_OUTPUT)
            outputs = _around(output, reach, step, LONGEST_OUTPUT)
            eam = _search(samples, rows, groups, window, totals, outputs, float(np.median(total)), eam.pairs)
        found.append(eam)
    best = found[0]
    for eam in found[1:]:
        best = best if best.mse <= 1.002 * eam.mse else eam
    return best


def _around(values: Array, reach: float, step: float, longest: float) -> Array:
    """The grid of `step` within `reach` of any of `values`."""
    grid = np.round(np.arange(0.0, longest + 1e-9, step), 7)
    chosen: Array = grid[(np.abs(grid[:, None] - values[None]) <= reach + 1e-9).any(axis=1)]
    return chosen


def _search(
    samples: Samples,
    rows: Bools,
    groups: NDArray[np.intp],
    window: float,
    totals: Array,
    outputs: Array,
    at: float,
    known: tuple[DelayPair, ...] = (),
) -> Eam:
    """The best pair of each group among these sums of both delays and output delays."""
    return _best(_Sums(samples, rows, totals, outputs, window, at), groups, totals, outputs, window, known)


def _best(
    sums: _Sums,
    groups: NDArray[np.intp],
    totals: Array,
    outputs: Array,
    window: float,
    known: tuple[DelayPair, ...],
) -> Eam:
    mse, g0, g1 = sums.solve(groups)
    inputs = totals[:, None] - outputs[None]
    allowed = (inputs >= -1e-9) & (inputs <= LONGEST_INPUT + 1e-9)
    mse = np.where(allowed[None], mse, np.inf)
    where = [np.unravel_index(np.argmin(one), one.shape) for one in mse]
    gains = np.array([[g[k][where[k]] for k in groups] for g in (g0, g1)])
    input_delay = np.array([max(inputs[where[k]], 0.0) for k in groups])
    output_delay = np.array([outputs[where[k][1]] for k in groups])
    share = np.array([sums.count[groups == k].sum() for k in range(len(mse))])
    error = float(sum(s * mse[k][where[k]] for k, s in enumerate(share)) / max(share.sum(), 1))
    tried = [
        DelayPair(round(max(float(inputs[a, b]), 0.0), 7), round(float(outputs[b]), 7), float(mse[0, a, b]))
        for a, b in zip(*np.nonzero(mse[0] < PROBABLE * mse[0].min()), strict=True)
    ]
    return Eam(gains, input_delay, output_delay, window, error, _probable([*known, *tried]))


def _probable(pairs: list[DelayPair]) -> tuple[DelayPair, ...]:
    """Those with less than 1.5 times the least error, the best one first."""
    latest = {(pair.input_delay_s, pair.output_delay_s): pair for pair in pairs}
    least = min((pair.mse for pair in latest.values()), default=0.0)
    probable = (pair for pair in latest.values() if pair.mse < PROBABLE * least or pair.mse == least)
    return tuple(sorted(probable, key=lambda pair: pair.mse))


def _stack(signals: Iterable[Array]) -> Array:
    """Signals (N, J), one for each delay, as one array (J, D, N)."""
    return np.ascontiguousarray(np.stack(list(signals)).transpose(2, 0, 1))


def _cross(a: Array, b: Array) -> Array:
    """(J, A, N), (J, B, N) -> (J, A, B)"""
    return a @ b.transpose(0, 2, 1)


def _norm(a: Array) -> Array:
    """(J, D, N) -> (J, D)"""
    return np.einsum("jdn,jdn->jd", a, a)
