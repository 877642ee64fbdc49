"""The empirical actuator model as the paper identifies it (Section 3.1), with delays below a millisecond.

For every pair of delays on a fine grid the gains, which all joints share, follow by linear regression; the pair that leaves
least is the model's, and what it leaves is the noise. The cross products that the regressions need are summed once for each
delay, not once for each pair, which is what makes the grid cheap.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import attrs
import numpy as np

from .log_signals import LogSignals
from .signals import Array, Bools, Samples, scattered_rows

LONGEST_INPUT, LONGEST_OUTPUT = 0.020, 0.006  # s
WINDOWS = (0.0, 0.001)
"""s, steps that a drive may have"""

_COARSE = 0.001  # s, step of the first grid
_REFINEMENTS = ((0.00075, 0.00025), (0.0002, 0.00005))  # s: reach about the best pair so far, step
_ENOUGH = 1500  # rows for the first, coarse look
_CHUNK = 20000  # rows summed at once


@attrs.frozen(eq=False)
class Eam:
    """Gains and delays of each joint, all joints alike."""

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

    def predict(self, samples: Samples) -> Array:
        """Torque of every row, (N, J), N m."""
        return pd_torque(samples, self.gains, self.input_delay, self.output_delay, self.window)


def pd_torque(
    samples: Samples, gains: Array, input_delay: Array | float, output_delay: Array | float, window: float
) -> Array:
    """Eq. 1 without its noise, (N, J), N m."""
    s = samples.at(input_delay, output_delay, window)
    torque: Array = gains[0] * s.stiffness_torque + gains[1] * s.damping_torque + s.tau_ff
    return torque


def fit_eam(samples: Samples, rows: Bools, windows: Sequence[float] = WINDOWS) -> Eam:
    """Fit the EAM to `rows` (N, J). The drive's step is the first of `windows` (s) unless a later one fits better."""
    few = np.zeros_like(rows)
    some = scattered_rows(len(rows), max(1, len(rows) // _ENOUGH))
    few[some] = rows[some]
    best, *others = (_fitted(samples, few, rows, window) for window in windows)
    for eam in others:
        best = best if best.mse <= 1.002 * eam.mse else eam
    return best


def _fitted(samples: Samples, few: Bools, rows: Bools, window: float) -> Eam:
    """The best fit with a step of the drive: on a coarse grid of delays with `few` rows, on finer ones about it with all."""
    longest = LONGEST_INPUT + LONGEST_OUTPUT, LONGEST_OUTPUT
    totals, outputs = (_grid(end, _COARSE) for end in longest)
    eam = _Sums(samples, few, totals, outputs, window, 0.0).best()
    for reach, step in _REFINEMENTS:
        about = eam.input_delay[0] + eam.output_delay[0], eam.output_delay[0]
        totals, outputs = (_grid(end, step, near, reach) for end, near in zip(longest, about, strict=True))
        eam = _Sums(samples, rows, totals, outputs, window, about[0]).best()
    return eam


def _grid(longest: float, step: float, about: float = 0.0, reach: float = np.inf) -> Array:
    """Delays from 0 to `longest` (s) within `reach` of `about`."""
    grid = np.round(np.arange(0.0, longest + 1e-9, step), 7)
    chosen: Array = grid[np.abs(grid - about) <= reach + 1e-9]
    return chosen


class _Sums:
    """Cross products of the shifted commands and states, so that any pair's regression is a 2 by 2 system.

    The torque less the feed-forward torque F is g0 (C - Q) + g1 (D - V) with C = kp q_des, D = kd dq_des and F shifted by
    the sum of both delays, Q = kp q and V = kd dq shifted by the output delay. Rows of a sum are such `totals`, columns
    `outputs`; gains count as they were commanded `at` s before a row.
    """

    def __init__(
        self, samples: Samples, rows: Bools, totals: Array, outputs: Array, window: float, at: float
    ) -> None:
        self._totals, self._outputs, self._window, self._at = totals, outputs, window, at
        self._joints, self._count = len(samples.joints), int(rows.sum())
        self._aa, self._ab, self._bb, self._az, self._bz, self._zz = np.zeros((6, len(totals), len(outputs)))
        offset = 0
        for one in samples.logs:
            for first in range(0, len(one.t), _CHUNK):
                t = one.t[first : first + _CHUNK]
                here = slice(offset + first, offset + first + len(t))
                if rows[here].any():
                    self._add(one, t, samples.tau[here], rows[here].astype(float))
            offset += len(one.t)

    def _add(self, one: LogSignals, t: Array, tau: Array, keep: Array) -> None:
        packet = one.command_rows(t - self._at)
        kp, kd = (one.gains[name][packet] * keep for name in ("kp", "kd"))
        c, d, f = (
            _stacked(one.command_at(name, t - late, self._window) * by for late in self._totals)
            for name, by in (("q_des", kp), ("dq_des", kd), ("tau_ff", keep))
        )
        q, v = (
            _stacked(one.state_at(name, t - late) * by for late in self._outputs)
            for name, by in (("q", kp), ("dq", kd))
        )
        z = (tau * keep).ravel() - f
        self._aa += _dot(c, c)[:, None] - 2.0 * c @ q.T + _dot(q, q)
        self._ab += _dot(c, d)[:, None] - c @ v.T - d @ q.T + _dot(q, v)
        self._bb += _dot(d, d)[:, None] - 2.0 * d @ v.T + _dot(v, v)
        self._az += _dot(c, z)[:, None] - z @ q.T
        self._bz += _dot(d, z)[:, None] - z @ v.T
        self._zz += _dot(z, z)[:, None]

    def best(self) -> Eam:
        """The pair with the least mean squared error, and its gains."""
        aa, ab, bb, az, bz = self._aa, self._ab, self._bb, self._az, self._bz
        det, ridge = aa * bb - ab * ab, 1e-12 * (aa + bb) ** 2 + 1e-300
        g0 = np.where(det > ridge, (bb * az - ab * bz) / np.maximum(det, ridge), az / np.maximum(aa, 1e-300))
        g1 = np.where(det > ridge, (aa * bz - ab * az) / np.maximum(det, ridge), 0.0)
        mse = np.maximum(self._zz - g0 * az - g1 * bz, 0.0) / max(self._count, 1)
        inputs = self._totals[:, None] - self._outputs
        possible = (inputs >= -1e-9) & (inputs <= LONGEST_INPUT + 1e-9)
        at = np.unravel_index(np.argmin(np.where(possible, mse, np.inf)), mse.shape)
        gains, delays = np.array([g0[at], g1[at]]), (max(inputs[at], 0.0), self._outputs[at[1]])
        every = np.ones(self._joints)
        return Eam(gains[:, None] * every, delays[0] * every, delays[1] * every, self._window, float(mse[at]))


def _stacked(signals: Iterable[Array]) -> Array:
    """Signals (N, J), one for each delay, as rows (D, N J)."""
    return np.stack([one.ravel() for one in signals])


def _dot(a: Array, b: Array) -> Array:
    """Row by row, (D,)."""
    return np.einsum("dn,dn->d", a, b)
