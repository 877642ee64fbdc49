"""Statistics of model selection: clustered score test, whiteness, thresholds.

`search` applies it to models; nothing is fitted here.
"""

from __future__ import annotations

import attrs
import numpy as np
from scipy import stats

from quadvel_description.arrays import Array, Bools

from ..data.split import DataSplit

SIGNIFICANCE_LEVEL = 0.01
"""Significance level of an effect, after Bonferroni correction for the number of candidates."""
MIN_EFFECT_SIZE = 0.03
"""Minimum error reduction of an effect on one joint, relative to the error that remains."""
MIN_REMOVABLE_SHARE = 0.01
"""Minimum error reduction of an effect on one joint, relative to what the plain EAM leaves above the noise."""
MAX_UNEXPLAINED_SHARE = 0.03
"""Share of what a less simple model explains that effects may leave and are still preferred."""
READING_ERROR_MARGIN = 2.0
"""Minimum error reduction of an effect, relative to the reading error of its joints.

Speeds by lines between slow rows were 0.4 to 3 times as wrong (mean square) as estimated on 43 of 46
joints of five logs of the second generator, and 8 to 120 times on three that are faster than the rows.
"""
PENALTY_PER_PARAMETER = 0.01
"""Minimum relative error reduction per parameter of a joint."""


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
    def joint_gain(self) -> Array:
        """Mean reduction of each joint's squared error, (J,), N^2 m^2."""
        gain: Array = self.error_reduction.sum(axis=0) / np.maximum(self.rows.sum(axis=0), 1)
        return gain

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


def compare_residuals(split: DataSplit, before: Array, after: Array, rows: Bools) -> Comparison:
    """Compare the residuals of two models on a set of rows.

    Args:
        split: Clusters of the rows.
        before: Residual of the first model, (N, J), N m.
        after: Residual of the second model, (N, J), N m.
        rows: Samples to compare, (N, J) bool.

    Returns:
        Cluster sums for the score test.
    """
    # d = e0 - e1 is the change of the prediction.
    e0, e1 = np.where(rows, before, 0.0), np.where(rows, after, 0.0)
    d = e0 - e1
    error_after = split.cluster_sums(e1**2)
    return Comparison(
        split.cluster_sums(e0**2) - error_after,
        error_after,
        split.cluster_sums(e0 * d),
        split.cluster_sums(e1 * d),
        split.cluster_sums(rows.astype(float)),
    )
