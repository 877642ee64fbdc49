"""Split of the samples into fitted, selection and reported rows, and into clusters.

Residuals of neighbouring rows are correlated. Every test therefore uses sums over clusters of at
least 0.1 s as its independent units (cluster-robust inference).
"""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools, Indices

from ..logs.excerpts import has_jitter
from ..options import SEARCH_DEFAULTS
from .dataset import Dataset
from .signals import Samples

CLUSTER_DURATION_S = 0.1
"""Duration, s, over which sums of residuals count as independent."""
_MIN_BLOCKS = 20
"""Blocks of a log, at least."""
MIN_BLOCK_S, _MAX_BLOCK_S = 0.2, 2.0
"""s; shortest and longest duration of the blocks that are fitted, used for selection, or held out."""


def block_length(dataset: Dataset, shortest: float = MIN_BLOCK_S) -> float:
    """Choose the length of the blocks.

    Args:
        dataset: The logs.
        shortest: Shortest block, s.

    Returns:
        Length, s.
    """
    spans = [log.duration for log in dataset.train]
    return float(np.clip(min(spans) / _MIN_BLOCKS, shortest, _MAX_BLOCK_S))


def reported_rows(dataset: Dataset, recording: int, t: Array, length: float) -> Bools:
    """Return which rows of a recording are reported.

    Of five consecutive blocks, one is reported. If there are held-out logs, these alone are. Where
    the stamps of a held-out recording have to be corrected, a fifth of it serves this purpose, and
    the other rows are reported.

    Args:
        dataset: The logs.
        recording: Index of the recording.
        t: Times of its rows, (N,), s.
        length: Length of the blocks of fitted logs, s.

    Returns:
        (N,) bool; these rows neither fit, nor select, nor correct stamps.
    """
    if not dataset.heldout:
        return np.asarray(np.floor(t / length) % 5 == 4)
    if not dataset.is_heldout(recording):
        return np.zeros(len(t), dtype=bool)
    if not any(log.has_own_command_stamps or has_jitter(log) for log in dataset.logs):
        return np.ones(len(t), dtype=bool)
    return np.asarray(np.floor(t / MIN_BLOCK_S) % 5 != 2)


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
    cluster_starts: Indices
    noise_overlap: int = 0

    @property
    def all_rows(self) -> Bools:
        """All samples of the three parts, (N, J) bool."""
        return self.fit | self.select | self.report

    @property
    def fit_or_select(self) -> Bools:
        """Samples that fit or select, (N, J) bool."""
        return self.fit | self.select

    def select_rows(self, rows: Indices) -> DataSplit:
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


def cluster_starts(samples: Samples, motion: float = SEARCH_DEFAULTS.cluster_motion_rad) -> Indices:
    """Divide the rows into clusters for the tests.

    A cluster begins where a log begins, or when at least `CLUSTER_DURATION_S` has passed and some
    joint has moved by `motion`: samples at rest are not independent.

    Args:
        samples: Rows of all logs.
        motion: Motion of some joint that ends a cluster, rad.

    Returns:
        Row at which each cluster begins, (C,).
    """
    # Intervals of CLUSTER_DURATION_S; merged while the angles of all joints stay within
    # `motion` of those in the first interval of the cluster.
    at = np.floor(samples.t / CLUSTER_DURATION_S).astype(int) + 10**7 * samples.log_of_row
    starts = np.flatnonzero(np.diff(at, prepend=at[0] - 1))
    q = samples.at(0.0, 0.0, 0.0).q
    log = samples.log_of_row[starts]
    lowest, highest = np.minimum.reduceat(q, starts, axis=0), np.maximum.reduceat(q, starts, axis=0)
    kept = [0]
    for k in range(1, len(starts)):
        last = kept[-1]
        moved = np.maximum(highest[k] - lowest[last], highest[last] - lowest[k]).max()
        if log[k] != log[last] or moved > motion:
            kept.append(k)
    return starts[kept]
