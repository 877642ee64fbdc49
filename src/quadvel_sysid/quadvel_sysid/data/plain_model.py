"""Empirical actuator model (EAM) of the paper, Section 3.1: PD gains and two delays.

A grid search over both delays solves a linear regression for the gains at each pair. All joints
share the gains. The pair with the least squared error is the model. An offset of a torque sensor or
an encoder can decide between delays: they are searched with a constant of each joint as well, and
the fit with constants counts if it explains the torque about its mean clearly better. The cross
products of the regressions separate into sums for each delay rather than each pair, which makes a
grid finer than a millisecond affordable.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools

from .log_signals import LogSignals
from .signals import Samples, scattered_rows

MAX_INPUT_DELAY_S, MAX_OUTPUT_DELAY_S = 0.020, 0.006
"""Upper bounds of the input and output delay, s."""
DRIVE_WINDOWS_S = (0.0, 0.001)
"""Steps of a drive to try, s; 0 for a drive without a step."""

_LONGEST_S = MAX_INPUT_DELAY_S + MAX_OUTPUT_DELAY_S, MAX_OUTPUT_DELAY_S
"""Upper bounds of the sum of both delays and of the output delay, s."""
_COARSE_STEP_S = 0.001
"""Step of the first grid, s."""
_REFINEMENTS_S = ((0.00075, 0.00025), (0.0002, 0.00005))
"""Half range around the best pair so far, and step, of each finer grid, s."""
_COARSE_ROWS = 1500
"""Rows that the first grid uses."""
_CLEARLY = 1.002
"""Ratio of errors from which on a later candidate replaces the first one."""
_CHUNK_ROWS = 20000
"""Rows of a partial sum, which bounds the memory."""


@attrs.frozen(eq=False)
class Eam:
    """Fitted EAM; the values of all joints are equal.

    Attributes:
        gains: Ratios of real to commanded kp and kd, (2, J).
        input_delay: Input delay, (J,), s.
        output_delay: Output delay, (J,), s.
        window: Step of the drive, over which commands are averaged, s; 0 for none.
        mse: Mean squared error of the fitted rows, N^2 m^2; after a fit with a constant of each joint,
            `variance`.
        variance: Least mean squared error with a constant of each joint, N^2 m^2.
    """

    gains: Array
    input_delay: Array
    output_delay: Array
    window: float
    mse: float
    variance: float

    @property
    def delays(self) -> tuple[float, float]:
        """Sum of both delays, and output delay, s."""
        output = float(self.output_delay[0])
        return float(self.input_delay[0]) + output, output

    def predict(self, samples: Samples) -> Array:
        """Predict the torque of every row.

        Args:
            samples: Rows of logs.

        Returns:
            Torque, (N, J), N m.
        """
        return pd_torque(samples, self.gains, self.input_delay, self.output_delay, self.window)


def pd_torque(
    samples: Samples, gains: Array, input_delay: Array | float, output_delay: Array | float, window: float
) -> Array:
    """Compute the torque of the PD law with delays, Eq. 1 of the paper without its noise.

        tau(t) = g_p kp (q_des(t - d_in - d_out) - q(t - d_out))
                 + g_d kd (dq_des(t - d_in - d_out) - dq(t - d_out)) + tau_ff(t - d_in - d_out)

    Args:
        samples: Rows of logs.
        gains: Gain ratios g_p and g_d, (2, J).
        input_delay: d_in, (J,) or scalar, s.
        output_delay: d_out, (J,) or scalar, s.
        window: Step of the drive, s; 0 for none.

    Returns:
        Torque, (N, J), N m.
    """
    s = samples.at(input_delay, output_delay, window)
    torque: Array = gains[0] * s.stiffness_torque + gains[1] * s.damping_torque + s.tau_ff
    return torque


def fit_eam(samples: Samples, rows: Bools, windows: Sequence[float] = DRIVE_WINDOWS_S) -> Eam:
    """Fit gains and delays by a grid search.

    Args:
        samples: Rows of logs.
        rows: Samples to fit, (N, J) bool.
        windows: Steps of a drive to try, s; the first counts unless a later one fits clearly
            better.

    Returns:
        The fitted model.
    """
    coarse_rows = np.zeros_like(rows)
    sampled = scattered_rows(len(rows), max(1, len(rows) // _COARSE_ROWS))
    coarse_rows[sampled] = rows[sampled]
    best, *others = (_search_delays(samples, coarse_rows, rows, window) for window in windows)
    for eam in others:
        best = best if best.mse <= _CLEARLY * eam.mse else eam
    return best


def _search_delays(samples: Samples, coarse_rows: Bools, rows: Bools, window: float) -> Eam:
    """Best fit for one drive step: coarse grid on `coarse_rows`, then finer grids on all rows."""
    totals, outputs = (_delay_grid(end, _COARSE_STEP_S) for end in _LONGEST_S)
    coarse = _CrossProducts(samples, coarse_rows, totals, outputs, window, 0.0)
    best, other = (
        _refine_delays(samples, rows, coarse.best_fit(about_means), about_means)
        for about_means in (False, True)
    )
    return best if best.variance <= _CLEARLY * other.variance else other


def _refine_delays(samples: Samples, rows: Bools, eam: Eam, about_means: bool) -> Eam:
    """Best fit on finer grids about the delays of `eam`, with a constant of each joint or without."""
    for reach, step in _REFINEMENTS_S:
        about = eam.delays
        totals, outputs = (
            _delay_grid(end, step, near, reach) for end, near in zip(_LONGEST_S, about, strict=True)
        )
        eam = _CrossProducts(samples, rows, totals, outputs, eam.window, about[0]).best_fit(about_means)
    return eam


def _delay_grid(longest: float, step: float, about: float = 0.0, reach: float = np.inf) -> Array:
    """Delays from 0 to `longest` (s) within `reach` of `about`."""
    grid = np.round(np.arange(0.0, longest + 1e-9, step), 7)
    chosen: Array = grid[np.abs(grid - about) <= reach + 1e-9]
    return chosen


class _CrossProducts:
    """Cross products of shifted commands and states, from which each pair's 2 by 2 system follows.

    With feed-forward torque F, the regression is

        tau - F = g_p (C - Q) + g_d (D - V)

    where C = kp q_des, D = kd dq_des and F are shifted by the sum of both delays (rows `totals`),
    and Q = kp q and V = kd dq by the output delay (columns `outputs`). Gains are those commanded
    `at` s before a row.
    """

    def __init__(
        self, samples: Samples, rows: Bools, totals: Array, outputs: Array, window: float, at: float
    ) -> None:
        """Sum the cross products.

        Args:
            samples: Rows of logs.
            rows: Samples to fit, (N, J) bool.
            totals: Sums of both delays, (T,), s.
            outputs: Output delays, (D,), s.
            window: Step of the drive, s; 0 for none.
            at: Age of the gains that count at a row, s.
        """
        self._totals, self._outputs, self._window, self._at = totals, outputs, window, at
        self._counts = rows.sum(axis=0)
        joints = len(self._counts)
        self._c, self._d, self._z = np.zeros((3, len(totals), joints))  # sums over the rows
        self._q, self._v = np.zeros((2, len(outputs), joints))
        self._aa, self._ab, self._bb, self._az, self._bz, self._zz = np.zeros((6, len(totals), len(outputs)))
        offset = 0
        for series in samples.sources.series:
            for first in range(0, len(series.t), _CHUNK_ROWS):
                t = series.t[first : first + _CHUNK_ROWS]
                here = slice(offset + first, offset + first + len(t))
                if rows[here].any():
                    self._add(series, t, samples.tau[here], rows[here].astype(float))
            offset += len(series.t)

    def _add(self, series: LogSignals, t: Array, tau: Array, keep: Array) -> None:
        """Add the rows at the times `t` of one log; `keep` is 1 on samples to fit, 0 on others."""
        # With a = C - Q, b = D - V and z = tau - F, each product of sums separates, for example
        #     a'a = C'C - 2 C'Q + Q'Q,   C by the row of the sum, Q by the column.
        packet = series.command_rows(t - self._at)
        kp, kd = (series.gains[name][packet] * keep for name in ("kp", "kd"))
        c, d, f = (
            _stack_rows(series.command_at(name, t - delay, self._window) * factor for delay in self._totals)
            for name, factor in (("q_des", kp), ("dq_des", kd), ("tau_ff", keep))
        )
        q, v = (
            _stack_rows(series.state_at(name, t - delay) * factor for delay in self._outputs)
            for name, factor in (("q", kp), ("dq", kd))
        )
        z = (tau * keep).ravel() - f
        self._aa += _row_products(c, c)[:, None] - 2.0 * c @ q.T + _row_products(q, q)
        self._ab += _row_products(c, d)[:, None] - c @ v.T - d @ q.T + _row_products(q, v)
        self._bb += _row_products(d, d)[:, None] - 2.0 * d @ v.T + _row_products(v, v)
        self._az += _row_products(c, z)[:, None] - z @ q.T
        self._bz += _row_products(d, z)[:, None] - z @ v.T
        self._zz += _row_products(z, z)[:, None]
        for total, signal in ((self._c, c), (self._d, d), (self._z, z), (self._q, q), (self._v, v)):
            total += signal.reshape(len(signal), len(t), -1).sum(axis=1)

    def _products(self, about_means: bool) -> tuple[Array, ...]:
        """The cross products aa, ab, bb, az, bz and zz, (T, D) each; also about the means of each joint."""
        products = self._aa, self._ab, self._bb, self._az, self._bz, self._zz
        if not about_means:
            return products
        # sum (x - mean x) (y - mean y) = x'y - (sum x) (sum y) / n, joint by joint
        share = 1.0 / np.maximum(self._counts, 1)
        a, b = self._c[:, None] - self._q, self._d[:, None] - self._v  # (T, D, J)
        z = np.broadcast_to(self._z[:, None], a.shape)
        pairs = (a, a), (a, b), (b, b), (a, z), (b, z), (z, z)
        return tuple(product - (x * y) @ share for product, (x, y) in zip(products, pairs, strict=True))

    def best_fit(self, about_means: bool = False) -> Eam:
        """Solve all regressions.

        Args:
            about_means: Whether a constant of each joint takes part in the fit.

        Returns:
            The EAM with the pair of delays that has the least mean squared error.
        """
        plain, centred = (_solve(*self._products(means)) for means in (False, True))
        *gains, error = centred if about_means else plain
        input_delays = self._totals[:, None] - self._outputs
        possible = (input_delays >= -1e-9) & (input_delays <= MAX_INPUT_DELAY_S + 1e-9)
        at = np.unravel_index(np.argmin(np.where(possible, error, np.inf)), error.shape)
        delays = max(input_delays[at], 0.0), self._outputs[at[1]]
        ones, count = np.ones(len(self._counts)), max(int(self._counts.sum()), 1)
        return Eam(
            gains=np.array([one[at] for one in gains])[:, None] * ones,
            input_delay=delays[0] * ones,
            output_delay=delays[1] * ones,
            window=self._window,
            mse=float(error[at]) / count,
            variance=float(centred[2][at]) / count,
        )


def _solve(aa: Array, ab: Array, bb: Array, az: Array, bz: Array, zz: Array) -> tuple[Array, Array, Array]:
    """Gains g_p and g_d and sum of squared errors of each pair of delays, (T, D) each."""
    # Cramer's rule for [aa ab; ab bb] [g0 g1]' = [az bz]'; g1 = 0 where b is 0 or collinear to a.
    det, ridge = aa * bb - ab * ab, 1e-12 * (aa + bb) ** 2 + 1e-300
    g0 = np.where(det > ridge, (bb * az - ab * bz) / np.maximum(det, ridge), az / np.maximum(aa, 1e-300))
    g1 = np.where(det > ridge, (aa * bz - ab * az) / np.maximum(det, ridge), 0.0)
    return g0, g1, np.maximum(zz - g0 * az - g1 * bz, 0.0)


def _stack_rows(signals: Iterable[Array]) -> Array:
    """Stack signals (N, J), one for each delay, as rows (D, N J)."""
    return np.stack([one.ravel() for one in signals])


def _row_products(a: Array, b: Array) -> Array:
    """Inner products of corresponding rows, (D,)."""
    return np.einsum("dn,dn->d", a, b)
