"""What decides: three parts of the data, a clustered test, an information criterion, and the noise of the torque.

Rows of the first part are fitted, those of the second select, those of the third are only reported. Residuals of
neighbouring rows are correlated, so that sums over clusters of 0.1 s are the units of every test.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import attrs
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from .signals import Array, Bools, Samples

CLUSTER_DURATION_S = 0.1
"""s: what residuals add up to over so long counts as independent"""
CLUSTER_MOTION_RAD = 0.02
"""rad: a cluster goes on until some joint has moved by this much: samples at rest are not independent"""
SIGNIFICANCE_LEVEL = 0.01
"""An effect is named if chance would bring its gain with less than this probability, all candidates counted"""
MIN_EFFECT_SIZE = 0.03
"""Of the error that it leaves: what an effect has to take off on the joint that shows it best"""
PENALTY_PER_PARAMETER = 0.01
"""Of a joint's error: what one more parameter there has to take off to be worth its word"""


@attrs.frozen(eq=False)
class DataSplit:
    """Which rows are fitted, select and are reported, (N, J); clusters begin at the rows `starts`."""

    fit: Bools
    select: Bools
    report: Bools
    starts: NDArray[np.intp]
    overlap: int = 0
    """rows after one that share the noise of its torque, as accelerations do that are differences of speeds"""

    @property
    def all_rows(self) -> Bools:
        return self.fit | self.select | self.report

    @property
    def fit_or_select(self) -> Bools:
        """The rows that fit and select."""
        return self.fit | self.select

    def select_rows(self, rows: NDArray[np.intp]) -> DataSplit:
        """The parts of these rows alone."""
        starts = np.unique(np.searchsorted(rows, self.starts))
        fit, select, report = (one[rows] for one in (self.fit, self.select, self.report))
        return DataSplit(fit, select, report, starts[starts < len(rows)], self.overlap)

    def cluster_sums(self, values: Array) -> Array:
        """Values (N, ...) summed over each cluster."""
        total: Array = np.add.reduceat(values, self.starts, axis=0)
        return total

    def compare(self, before: Array, after: Array, rows: Bools) -> Comparison:
        """Residuals (N, J) `before` and `after` a change of the model, on some rows."""
        e0, e1 = np.where(rows, before, 0.0), np.where(rows, after, 0.0)
        d = e0 - e1
        after = self.cluster_sums(e1**2)
        return Comparison(
            self.cluster_sums(e0**2) - after,
            after,
            self.cluster_sums(e0 * d),
            self.cluster_sums(e1 * d),
            self.cluster_sums(rows.astype(float)),
        )


@attrs.frozen(eq=False)
class Comparison:
    """Two predictions on some rows, summed over clusters and for each joint, (clusters, J).

    A score test: with residuals e0 and e1 and the difference of the predictions d = e0 - e1, the sum of e0 d is zero but
    for noise if d has nothing to do with what was measured. The size of that noise is the clusters' sums of e1 d, over the
    joints as well: what shakes a robot shakes its joints together.
    """

    error_reduction: Array  # e0^2 - e1^2
    error_after: Array  # e1^2
    score: Array  # e0 d
    noise: Array  # e1 d
    rows: Array

    @property
    def gain(self) -> float:
        """Mean fall of the squared error over all rows, N^2 m^2."""
        return float(self.error_reduction.sum() / max(self.rows.sum(), 1))

    @property
    def share(self) -> Array:
        """How much of each joint's squared error the fall is, as a share of what is left after it, (J,)."""
        share: Array = self.error_reduction.sum(axis=0) / np.maximum(self.error_after.sum(axis=0), 1e-300)
        return share

    @property
    def p_joints(self) -> Array:
        """Of each joint: how likely chance brings such a score, one-sided, (J,); 1 where the error does not fall."""
        return _score_test(self.error_reduction, self.score, self.noise, self.rows)

    @property
    def p(self) -> float:
        """Of all joints together or, Bonferroni's way, of the clearest one alone, whichever says more."""
        sums = (
            x.sum(axis=1, keepdims=True) for x in (self.error_reduction, self.score, self.noise, self.rows)
        )
        return float(min(_score_test(*sums)[0], self.p_joints.min() * self.rows.shape[1]))


_MIN_CLUSTERS = 4
"""Clusters below which nothing is known of the size of the noise"""


def _score_test(fall: Array, score: Array, noise: Array, rows: Array) -> Array:
    """p-values (K,) of a score test on the sums of clusters (clusters, K), one-sided; 1 where the error does not fall."""
    used = (rows > 0).sum(axis=0)
    size = np.sqrt(np.sum(noise**2, axis=0)) + 1e-300
    p = stats.t.sf(score.sum(axis=0) / size, np.maximum(used - 1, 1))
    chance: Array = np.where((fall.sum(axis=0) > 0.0) & (used >= _MIN_CLUSTERS), p, 1.0)
    return chance


WHITENESS_LEVEL = 0.001
"""p-value of the whiteness test below which a residual holds structure"""
_WHITENESS_LAGS = 20
"""Rows over which its correlation is looked at"""


def whiteness(residual: Array, rows: Bools, start: Bools, overlap: int = 0) -> Array:
    """p-values (J,) of Ljung and Box's test that a residual (N, J) is white on `rows`.

    start (N,): where stretches begin. overlap: rows within which the noise itself is correlated; these lags are left out, and
    the variance of the others is Bartlett's.
    """
    left = np.where(rows, residual, 0.0)  # about zero: an offset is structure, too
    power = np.sum(left * left, axis=0) + 1e-300
    count, total, variance = rows.sum(axis=0), np.zeros(left.shape[1]), np.ones(left.shape[1])
    stretch = np.cumsum(start)
    for lag in range(1, overlap + _WHITENESS_LAGS + 1):
        same = (stretch[lag:] == stretch[:-lag])[:, None]
        pairs = rows[lag:] & rows[:-lag] & same
        r = np.sum(left[lag:] * left[:-lag] * pairs, axis=0) / power
        if lag > overlap:
            total += r * r * count**2 / np.maximum(pairs.sum(axis=0), 1)
        else:
            variance += 2.0 * r * r
    return np.asarray(stats.chi2.sf(total / variance, _WHITENESS_LAGS))


def normality(residual: Array, rows: Bools) -> Array:
    """p-values (J,) of a residual's kurtosis on `rows`: an effect that comes and goes within rows shows by it alone."""
    each = (one[keep] for one, keep in zip(residual.T, rows.T, strict=True))
    return np.array([stats.kurtosistest(one).pvalue if np.ptp(one) > 0.0 else 1.0 for one in each])


def clusters(samples: Samples) -> NDArray[np.intp]:
    """The rows at which clusters begin: where a log does, or after CLUSTER s in which some joint has moved by STILL."""
    at = np.floor(samples.t / CLUSTER_DURATION_S).astype(int) + 10**7 * samples.log_of_row
    starts = np.flatnonzero(np.diff(at, prepend=at[0] - 1))
    q = samples.at(0.0, 0.0, 0.0).q
    log = samples.log_of_row[starts]
    lowest, highest = np.minimum.reduceat(q, starts, axis=0), np.maximum.reduceat(q, starts, axis=0)
    kept = [0]
    for k in range(1, len(starts)):
        last = kept[-1]
        away = np.maximum(highest[k] - lowest[last], highest[last] - lowest[k]).max()
        if log[k] != log[last] or away > CLUSTER_MOTION_RAD:
            kept.append(k)
    return starts[kept]


_DIFFERENCE_ORDERS = (2, 3, 4, 5)
_INNER, _INNER_VARIANCE = 0.9, 0.5607  # of a normal variable's variance lies within its inner nine tenths


def noise_variance(samples: Samples, rows: Bools, residual: Array) -> Array:
    """Variance of the torque's noise (J,), N^2 m^2, from differences of consecutive rows, which a smooth torque hardly has.

    Commands that step are no noise: differences are also taken of what a model leaves, and the lesser counts. Where a torque
    comes in coarse ticks most rows repeat the one before: it is off by the rounding to them at least. One that never changes
    has the noise of the others.
    """
    found = np.minimum(
        _difference_variance(samples.tau, samples, rows), _difference_variance(residual, samples, rows)
    )
    ticks = np.array([_resolution(one[keep]) for one, keep in zip(samples.tau.T, rows.T, strict=True)])
    found = np.maximum(found, ticks**2 / 12.0)
    shows = found > 0.0
    return np.where(shows, found, found[shows].mean() if shows.any() else 1.0)


def _resolution(x: Array) -> float:
    """The least difference of two different values, but for rounding; 0 where there are none."""
    span = float(np.ptp(x))
    return span * float(np.diff(np.unique(np.round(x / span, 9))).min()) if span > 0.0 else 0.0


def encoder_variance(samples: Samples, rows: Bools, kp: float, kd: float) -> Array:
    """Variance of what the noise of the measured q and dq makes of the torque asked for at these gains, (J,), N^2 m^2."""
    q, dq = (np.concatenate([one.states[name] for one in samples.logs]) for name in ("q", "dq"))
    return kp**2 * _difference_variance(q, samples, rows) + kd**2 * _difference_variance(dq, samples, rows)


def _difference_variance(values: Array, samples: Samples, rows: Bools) -> Array:
    """The least of the variances that differences of several orders show, each without its largest tenth."""
    found = []
    for order in _DIFFERENCE_ORDERS:
        differences = np.diff(values, order, axis=0)
        whole = rows[order:].copy()
        for back in range(1, order + 1):
            new = samples.start[order - back + 1 : len(rows) - back + 1, None]
            whole &= rows[order - back : -back] & ~new
        spread: Sequence[float] = [
            _robust_variance(differences[whole[:, j], j]) for j in range(rows.shape[1])
        ]
        found.append(np.array(spread) / comb(2 * order, order))
    least: Array = np.min(found, axis=0)
    return least


def _robust_variance(x: Array) -> float:
    """Variance of the inner nine tenths, scaled to that of normal numbers."""
    if len(x) < 20:
        return float("inf")
    inner = np.abs(x) <= np.quantile(np.abs(x), _INNER)
    return float(np.sum(x[inner] ** 2) / len(x) / _INNER_VARIANCE)
