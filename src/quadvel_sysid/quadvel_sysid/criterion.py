"""Statistics of model selection: data split, clustered score test, whiteness, noise variance.

The rows are split into three parts: fitted rows, selection rows and reported rows. Residuals of
neighbouring rows are correlated. Every test therefore uses sums over clusters of at least 0.1 s as
its independent units (cluster-robust inference).
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
"""Duration, s, over which sums of residuals count as independent."""
CLUSTER_MOTION_RAD = 0.02
"""Motion, rad, of some joint that ends a cluster: samples at rest are not independent."""
SIGNIFICANCE_LEVEL = 0.01
"""Significance level of an effect, after Bonferroni correction for the number of candidates."""
MIN_EFFECT_SIZE = 0.03
"""Minimum error reduction of an effect on one joint, relative to the error that remains."""
PENALTY_PER_PARAMETER = 0.01
"""Minimum relative error reduction per parameter of a joint."""


@attrs.frozen(eq=False)
class DataSplit:
    """Split of the samples into fitted, selection and reported rows, and into clusters.

    Attributes:
        fit: Fitted samples, (N, J) bool.
        select: Samples that select effects, (N, J) bool.
        report: Samples that neither fit nor select, (N, J) bool; errors are reported on them.
        cluster_starts: Row at which each cluster begins, (C,).
        noise_overlap: Number of following rows that share the noise of a row's torque. It is above
            0 for torques from accelerations, which are differences of speeds.
    """

    fit: Bools
    select: Bools
    report: Bools
    cluster_starts: NDArray[np.intp]
    noise_overlap: int = 0

    @property
    def all_rows(self) -> Bools:
        """All samples of the three parts, (N, J) bool."""
        return self.fit | self.select | self.report

    @property
    def fit_or_select(self) -> Bools:
        """Samples that fit or select, (N, J) bool."""
        return self.fit | self.select

    def select_rows(self, rows: NDArray[np.intp]) -> DataSplit:
        """Restrict the split to a subset of rows.

        Args:
            rows: Ascending row numbers, (n,).

        Returns:
            The split of these rows.
        """
        starts = np.unique(np.searchsorted(rows, self.cluster_starts))
        fit, select, report = (one[rows] for one in (self.fit, self.select, self.report))
        return DataSplit(fit, select, report, starts[starts < len(rows)], self.noise_overlap)

    def cluster_sums(self, values: Array) -> Array:
        """Sum values over each cluster.

        Args:
            values: Values of the rows, (N, ...).

        Returns:
            Sums, (C, ...).
        """
        total: Array = np.add.reduceat(values, self.cluster_starts, axis=0)
        return total

    def compare(self, before: Array, after: Array, rows: Bools) -> Comparison:
        """Compare the residuals of two models on a set of rows.

        Args:
            before: Residual of the first model, (N, J), N m.
            after: Residual of the second model, (N, J), N m.
            rows: Samples to compare, (N, J) bool.

        Returns:
            Cluster sums for the score test.
        """
        # d = e0 - e1 is the change of the prediction.
        e0, e1 = np.where(rows, before, 0.0), np.where(rows, after, 0.0)
        d = e0 - e1
        error_after = self.cluster_sums(e1**2)
        return Comparison(
            self.cluster_sums(e0**2) - error_after,
            error_after,
            self.cluster_sums(e0 * d),
            self.cluster_sums(e1 * d),
            self.cluster_sums(rows.astype(float)),
        )


@attrs.frozen(eq=False)
class Comparison:
    """Score test of two predictions, as sums over clusters.

    With the residuals e0 and e1 and the difference of the predictions d = e0 - e1, the sum of e0 d
    has mean zero under the null hypothesis that d is unrelated to the measured torque. Its variance
    is that of the cluster sums of e1 d. Sums of several joints are added before they are squared,
    as one disturbance moves all joints of a robot.

    Attributes:
        error_reduction: e0^2 - e1^2, (C, J), N^2 m^2.
        error_after: e1^2, (C, J), N^2 m^2.
        score: e0 d, (C, J), N^2 m^2.
        noise: e1 d, (C, J), N^2 m^2.
        rows: Number of rows, (C, J).
    """

    error_reduction: Array
    error_after: Array
    score: Array
    noise: Array
    rows: Array

    @property
    def gain(self) -> float:
        """Mean reduction of the squared error over all rows, N^2 m^2."""
        return float(self.error_reduction.sum() / max(self.rows.sum(), 1))

    @property
    def relative_gain(self) -> Array:
        """Reduction of each joint's squared error, relative to the error after it, (J,)."""
        share: Array = self.error_reduction.sum(axis=0) / np.maximum(self.error_after.sum(axis=0), 1e-300)
        return share

    @property
    def joint_p_values(self) -> Array:
        """One-sided p-value of each joint, (J,); 1 where the error does not decrease."""
        return _score_test(self.error_reduction, self.score, self.noise, self.rows)

    @property
    def p_value(self) -> float:
        """Smaller p-value of all joints pooled and the best joint (Bonferroni-corrected)."""
        sums = (
            x.sum(axis=1, keepdims=True) for x in (self.error_reduction, self.score, self.noise, self.rows)
        )
        return float(min(_score_test(*sums)[0], self.joint_p_values.min() * self.rows.shape[1]))


_MIN_CLUSTERS = 4
"""Minimum number of clusters: with fewer the variance of the score is unknown."""


def _score_test(fall: Array, score: Array, noise: Array, rows: Array) -> Array:
    """One-sided p-values (K,) from cluster sums (C, K); 1 where the error does not decrease."""
    # Score statistic with a cluster-robust variance, over the clusters c:
    #     S = sum_c s_c,  s_c = sum of e0 d in c        (0 on average under the null hypothesis)
    #     V = sum_c n_c^2,  n_c = sum of e1 d in c      (e1 is free of the effect under test)
    #     t = S / sqrt(V)  ~  Student's t with C - 1 degrees of freedom
    used = (rows > 0).sum(axis=0)
    deviation = np.sqrt(np.sum(noise**2, axis=0)) + 1e-300
    p = stats.t.sf(score.sum(axis=0) / deviation, np.maximum(used - 1, 1))
    p_values: Array = np.where((fall.sum(axis=0) > 0.0) & (used >= _MIN_CLUSTERS), p, 1.0)
    return p_values


WHITENESS_LEVEL = 0.001
"""Significance level of the whiteness and normality tests."""
_WHITENESS_LAG_ROWS = 20
"""Number of autocorrelation lags in the whiteness test, rows."""


def whiteness_p_values(residual: Array, rows: Bools, start: Bools, noise_overlap: int = 0) -> Array:
    """Test whether a residual is white noise (Ljung-Box test).

    Lags within `noise_overlap` are left out. The variance of the other autocorrelations is
    Bartlett's, which grows by twice the sum of the squared autocorrelations of the lags left out.

    Args:
        residual: Residual, (N, J), N m.
        rows: Samples to test, (N, J) bool.
        start: Rows at which a contiguous stretch begins, (N,) bool.
        noise_overlap: Number of following rows with correlated measurement noise.

    Returns:
        p-values, (J,).
    """
    # Ljung-Box statistic with autocorrelations r_k of the n samples of a joint:
    #     Q = sum_{k=m+1}^{m+h} n^2 r_k^2 / (number of pairs at lag k)
    # Noise correlated over m lags gives r_k the variance (1 + 2 sum_{k<=m} r_k^2) / n (Bartlett),
    # so that Q / (1 + 2 sum_{k<=m} r_k^2) has a chi-squared distribution with h degrees of freedom.
    # The mean is not subtracted: an offset is structure, too.
    residual = np.where(rows, residual, 0.0)
    power = np.sum(residual * residual, axis=0) + 1e-300
    count, total, variance = rows.sum(axis=0), np.zeros(residual.shape[1]), np.ones(residual.shape[1])
    stretch = np.cumsum(start)
    for lag in range(1, noise_overlap + _WHITENESS_LAG_ROWS + 1):
        same = (stretch[lag:] == stretch[:-lag])[:, None]
        pairs = rows[lag:] & rows[:-lag] & same
        r = np.sum(residual[lag:] * residual[:-lag] * pairs, axis=0) / power
        if lag > noise_overlap:
            total += r * r * count**2 / np.maximum(pairs.sum(axis=0), 1)
        else:
            variance += 2.0 * r * r
    return np.asarray(stats.chi2.sf(total / variance, _WHITENESS_LAG_ROWS))


def normality_p_values(residual: Array, rows: Bools) -> Array:
    """Test whether a residual has the kurtosis of a normal distribution.

    An intermittent effect within rows keeps the residual white and is visible in its kurtosis
    alone.

    Args:
        residual: Residual, (N, J), N m.
        rows: Samples to test, (N, J) bool.

    Returns:
        p-values, (J,); 1 for a constant residual.
    """
    each = (one[keep] for one, keep in zip(residual.T, rows.T, strict=True))
    return np.array([stats.kurtosistest(one).pvalue if np.ptp(one) > 0.0 else 1.0 for one in each])


def cluster_starts(samples: Samples) -> NDArray[np.intp]:
    """Divide the rows into clusters for the tests.

    A cluster begins where a log begins, or when at least `CLUSTER_DURATION_S` has passed and some
    joint has moved by `CLUSTER_MOTION_RAD`.

    Args:
        samples: Rows of all logs.

    Returns:
        Row at which each cluster begins, (C,).
    """
    # Intervals of CLUSTER_DURATION_S; merged while the angles of all joints stay within
    # CLUSTER_MOTION_RAD of those in the first interval of the cluster.
    at = np.floor(samples.t / CLUSTER_DURATION_S).astype(int) + 10**7 * samples.log_of_row
    starts = np.flatnonzero(np.diff(at, prepend=at[0] - 1))
    q = samples.at(0.0, 0.0, 0.0).q
    log = samples.log_of_row[starts]
    lowest, highest = np.minimum.reduceat(q, starts, axis=0), np.maximum.reduceat(q, starts, axis=0)
    kept = [0]
    for k in range(1, len(starts)):
        last = kept[-1]
        moved = np.maximum(highest[k] - lowest[last], highest[last] - lowest[k]).max()
        if log[k] != log[last] or moved > CLUSTER_MOTION_RAD:
            kept.append(k)
    return starts[kept]


_DIFFERENCE_ORDERS = (2, 3, 4, 5)
_INNER_FRACTION, _INNER_VARIANCE = (
    0.9,
    0.5607,
)  # of a normal variable's variance lies within its inner nine tenths


def noise_variance(samples: Samples, rows: Bools, residual: Array) -> Array:
    """Estimate the variance of the torque noise from differences of consecutive rows.

    A smooth torque hardly contributes to differences of order 2 to 5. Step commands do, so that the
    residual of a model is differenced as well and the smaller estimate counts. The quantisation
    noise D^2 / 12 of a torque with the resolution D is a lower bound. A joint with a constant
    torque gets the mean of the other joints.

    Args:
        samples: Rows of all logs.
        rows: Samples to use, (N, J) bool.
        residual: Residual of a model, (N, J), N m.

    Returns:
        Variance, (J,), N^2 m^2.
    """
    from_torque = _difference_variance(samples.tau, samples, rows)
    from_residual = _difference_variance(residual, samples, rows)
    found = np.minimum(from_torque, from_residual)
    # Rounding to multiples of D is an error with uniform distribution over D, of variance D^2 / 12.
    ticks = np.array([_quantisation_step(one[keep]) for one, keep in zip(samples.tau.T, rows.T, strict=True)])
    found = np.maximum(found, ticks**2 / 12.0)
    is_known = found > 0.0
    return np.where(is_known, found, found[is_known].mean() if is_known.any() else 1.0)


def _quantisation_step(x: Array) -> float:
    """Smallest difference of two distinct values, apart from round-off; 0 for a constant."""
    span = float(np.ptp(x))
    return span * float(np.diff(np.unique(np.round(x / span, 9))).min()) if span > 0.0 else 0.0


def encoder_variance(samples: Samples, rows: Bools, kp: float, kd: float) -> Array:
    """Estimate the torque variance that encoder noise causes through the PD gains.

        var = kp^2 var(q) + kd^2 var(dq)

    Args:
        samples: Rows of all logs.
        rows: Samples to use, (N, J) bool.
        kp: Position gain, N m/rad.
        kd: Velocity gain, N m s/rad.

    Returns:
        Variance, (J,), N^2 m^2.
    """
    q, dq = (np.concatenate([one.states[name] for one in samples.logs]) for name in ("q", "dq"))
    return kp**2 * _difference_variance(q, samples, rows) + kd**2 * _difference_variance(dq, samples, rows)


def _difference_variance(values: Array, samples: Samples, rows: Bools) -> Array:
    """Smallest noise variance (J,) over difference orders 2 to 5."""
    # White noise of variance s^2 has differences of order k with the variance s^2 binom(2k, k).
    # The smallest estimate over k counts, as the signal itself adds to each of them.
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
    """Variance of the inner nine tenths, scaled to that of a normal distribution."""
    if len(x) < 20:
        return float("inf")
    inner = np.abs(x) <= np.quantile(np.abs(x), _INNER_FRACTION)
    return float(np.sum(x[inner] ** 2) / len(x) / _INNER_VARIANCE)
