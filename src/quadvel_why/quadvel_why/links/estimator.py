"""Estimator: does the estimated velocity agree with the planted feet, and with the estimator on what was recorded?"""

from __future__ import annotations

from functools import lru_cache

import attrs
import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array, Bools

from ..cause import NOTHING, Cause, Link, Measurement, Trace, worst_span
from ..signals import Signals

OTHER_ESTIMATOR_M_S = 0.06
"""Up to this difference to the shipped estimator, m/s, only the part that bias, scale or lag explain counts.

Another sound estimator differs by so much as well.
"""
LAGS_S = np.arange(0.0, 0.51, 0.005)
MIN_ROWS = 40


@attrs.frozen(eq=False)
class EstimateFit:
    """Deviation of the estimated velocity from a reference, and its best explanation.

    Attributes:
        kind: "bias", "scale" or "lag".
        amount: Bias (m/s), scale (factor) or lag (s), as `kind` states.
        axis: Axis with the largest error.
        error: Root mean square of estimate minus reference, m/s.
        left: The same after the deviation of `kind` is removed, m/s.
        time: (k,), s.
        estimate: (k, 3), m/s.
        reference: (k, 3), m/s.
        source: Description of the reference, for the sentence of the cause.
    """

    kind: str
    amount: float
    axis: int
    error: float
    left: float
    time: Array
    estimate: Array
    reference: Array
    source: str

    @property
    def size(self) -> float:
        """Deviation that counts, m/s."""
        return self.error if self.error > OTHER_ESTIMATOR_M_S else self.error - self.left


@lru_cache(maxsize=4)
def fit_estimate(signals: Signals) -> EstimateFit | None:
    """Compare the estimate with the planted feet, and name what differs.

    Args:
        signals: The run.

    Returns:
        The fit; None if the run shows too little.
    """
    run = signals.run
    own = {"torque", "imu", "robot"} <= signals.parts
    if not own:
        return None
    estimate, replayed = signals.estimate, signals.replayed_estimate
    use = run.walking & np.isfinite(replayed).all(axis=1)
    if use.sum() < MIN_ROWS:
        return None
    error = _rms((estimate - replayed)[use])
    feet = signals.legs.trunk_velocity
    planted = use & np.isfinite(feet).all(axis=1)
    from_feet = (
        float(np.sqrt(np.median(((estimate - feet)[planted, :2] ** 2).sum(axis=1)))) if planted.any() else 0.0
    )
    source = f"the planted feet, which differ by {from_feet:.2f} m/s on the median, and the shipped estimator"
    axis = int(np.argmax((((estimate - replayed)[use])[:, :2] ** 2).mean(axis=0)))
    kind, amount, left = _best_kind(run.time, estimate, replayed, use)
    return EstimateFit(kind, amount, axis, error, left, run.time[use], estimate[use], replayed[use], source)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values[:, :2] ** 2)))


def _best_kind(time: Array, estimate: Array, reference: Array, use: Bools) -> tuple[str, float, float]:
    """Bias, scale or lag: the kind with the smallest remaining error, its amount and that error."""
    off = (estimate - reference)[use][:, :2]
    bias = np.median(off, axis=0)
    found = [(_rms(off - bias), "bias", float(bias[np.argmax(np.abs(bias))]))]
    x, y = reference[use][:, :2].ravel(), estimate[use][:, :2].ravel()
    scale = float(x @ y) / max(float(x @ x), 1e-9)
    found.append((float(np.sqrt(np.mean((y - scale * x) ** 2))), "scale", scale))
    for lag in LAGS_S[1:]:
        late = np.column_stack([np.interp(time - lag, time, axis) for axis in reference.T])
        found.append((_rms((estimate - late)[use]), "lag", float(lag)))
    left, kind, amount = min(found)
    return kind, amount, left


class _Estimate(Cause):
    """What the causes of a wrong estimate share."""

    link = Link.ESTIMATOR
    unit = "m/s"
    least = 0.02
    needs = ("estimate",)
    kind = ""

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        found = fit_estimate(signals)
        if found is None:
            return None
        if found.kind != self.kind:
            return NOTHING
        axis = found.axis
        trace = Trace(
            f"velocity along {'xyz'[axis]}, m/s",
            found.time,
            found.estimate[:, axis],
            found.reference[:, axis],
        )
        sentence = f"{self.describe(found.amount)}; compared with {found.source}: {found.error:.2f} m/s, then {found.left:.2f}"
        off = np.abs(found.estimate - found.reference)[:, axis]
        return Measurement(found.size, sentence, worst_span(found.time, off), (trace,))

    def describe(self, amount: float) -> str:
        """Return the amount in words."""
        raise NotImplementedError


class EstimateBias(_Estimate):
    """The estimated velocity is off by a constant."""

    kind = "bias"
    remedy = "Replay the estimator: `quadvel replay`; look for an offset of the accelerometer or of a frame"

    @override
    def describe(self, amount: float) -> str:
        return f"the estimate is {amount:+.2f} m/s off all the time"


class EstimateScale(_Estimate):
    """The estimated velocity is too large or too small by a factor, or has the other sign."""

    kind = "scale"
    remedy = "Compare unit and sign of the estimate with `velocity_estimate` of this stack (m/s, body frame)"

    @override
    def describe(self, amount: float) -> str:
        return f"the estimate is {amount:.2f} times the velocity"


class EstimateLag(_Estimate):
    """The estimated velocity comes late."""

    kind = "lag"
    remedy = (
        "Look for a filter or a queue between states and estimate; the estimate of a state is due within 5 ms"
    )

    @override
    def describe(self, amount: float) -> str:
        return f"the estimate is {1e3 * amount:.0f} ms late"
