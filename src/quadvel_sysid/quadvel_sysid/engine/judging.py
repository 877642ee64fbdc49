"""Which rows are fitted, which judge, and whether one prediction is better than another on those that judge."""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from .signals import Array, Bools, Samples

BLOCK = 0.1
"""s: what residuals add up to over so long counts as independent"""

STILL = 0.02
"""rad: while no joint has moved so far, a robot says but once what it says"""


@attrs.frozen(eq=False)
class Comparison:
    """Two predictions on the rows that judge, summed over blocks and for each joint, (blocks, J).

    With residuals e0 and e1 and the difference of the predictions d = e0 - e1: if d has nothing to do with what was
    measured, the sum of e0 d is zero but for noise, whose size is that of the sums of e1 d. This holds whatever the
    correlation of residuals within a block, and is sharp where the effect itself comes and goes.
    """

    fall: Array  # e0^2 - e1^2
    score: Array  # e0 d
    noise: Array  # e1 d
    rows: Array  # judged

    @property
    def gain(self) -> float:
        """Mean fall of the squared error over all judged rows, N^2 m^2."""
        return float(self.fall.sum() / max(self.rows.sum(), 1))

    @property
    def joint_gain(self) -> Array:
        """The same over each joint's own rows, (J,)."""
        gain: Array = self.fall.sum(axis=0) / np.maximum(self.rows.sum(axis=0), 1)
        return gain

    @property
    def p_joints(self) -> Array:
        """Of each joint: how likely chance brings such a score, one-sided, (J,); 1 where the error does not fall."""
        used = self.rows > 0
        size = np.sqrt(np.sum(self.noise**2, axis=0)) + 1e-300
        p = stats.t.sf(self.score.sum(axis=0) / size, np.maximum(used.sum(axis=0) - 1, 1))
        chance: Array = np.where((self.fall.sum(axis=0) > 0.0) & (used.sum(axis=0) >= 4), p, 1.0)
        return chance

    @property
    def p(self) -> float:
        """The same of all joints together."""
        count = int((self.rows > 0).sum())
        if count < 4 or self.fall.sum() <= 0.0:
            return 1.0
        size = float(np.sqrt(np.sum(self.noise**2))) + 1e-300
        return float(stats.t.sf(self.score.sum() / size, count - 1))

    @property
    def p_any(self) -> float:
        """Of all joints together or of the clearest one alone, whichever says more."""
        return float(min(self.p, 1.0, self.p_joints.min() * self.rows.shape[1]))


@attrs.frozen(eq=False)
class Judge:
    """Rows to fit, to judge by, and to take the values from once the model is chosen, (N, J).

    Blocks of consecutive rows begin at the rows `starts`.
    """

    joints: tuple[str, ...]
    fit: Bools
    judge: Bools
    every: Bools
    starts: NDArray[np.intp]

    @classmethod
    def of(cls, samples: Samples, fit_rows: Bools, judge_rows: Bools, every: Bools | None = None) -> Judge:
        """Blocks of BLOCK s, longer where nothing moves; values from the fitted rows unless `every` says from more."""
        at = np.floor(samples.t / BLOCK).astype(int) + 10**7 * samples.log_of_row
        starts = np.flatnonzero(np.diff(at, prepend=at[0] - 1))
        starts = _moved(starts, samples)
        return cls(samples.joints, fit_rows, judge_rows, fit_rows if every is None else every, starts)

    def sums(self, values: Array) -> Array:
        """Values (N, ...) summed over each block."""
        total: Array = np.add.reduceat(values, self.starts, axis=0)
        return total

    def compare(self, before: Array, after: Array) -> Comparison:
        """Residuals (N, J) `before` and `after` a change of the model."""
        e0, e1 = np.where(self.judge, before, 0.0), np.where(self.judge, after, 0.0)
        d = e0 - e1
        return Comparison(
            self.sums(e0**2 - e1**2),
            self.sums(e0 * d),
            self.sums(e1 * d),
            self.sums(self.judge.astype(float)),
        )


def _moved(starts: NDArray[np.intp], samples: Samples) -> NDArray[np.intp]:
    """Those of the blocks that a log begins with, or in which a joint moves away from where it was in the last of them."""
    q = samples.at(0.0, 0.0, 0.0).q
    log = samples.log_of_row[starts]
    lowest, highest = np.minimum.reduceat(q, starts, axis=0), np.maximum.reduceat(q, starts, axis=0)
    kept = [0]
    for k in range(1, len(starts)):
        last = kept[-1]
        away = np.maximum(highest[k] - lowest[last], highest[last] - lowest[k]).max()
        if log[k] != log[last] or away > STILL:
            kept.append(k)
    return starts[kept]
