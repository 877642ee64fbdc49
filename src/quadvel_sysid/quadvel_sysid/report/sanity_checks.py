"""Sanity checks of a result: models that must not be used, and why.

A plausible drive has gains near the commanded ones and delays within their range, and its torque is
mostly explained by the PD law. Logs with a gross fault (dead speeds, a command column that holds the
next state) fit well but are not plausible.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools

from ..data.split import DataSplit
from ..model.torque_model import MAX_DELAYS_S, Model
from ..search.regressors import RegressorCandidate
from ..statistics.baselines import FILTER_SPAN_S
from ..statistics.criterion import MAX_UNEXPLAINED_SHARE

MAX_REPLAY_ERROR_RAD = 1.0
"""Replay error, rad, above which a replay is no evidence for the model."""
MIN_EXPLAINED_FRACTION = 0.5
"""Minimum fraction of the torque's variance that a valid model explains."""
BASELINE_ERROR_RATIO = 1.05
"""Error ratio to a baseline above which the model is worse than the baseline."""
GAIN_RATIOS = 0.2, 4.0
"""Plausible ratios of real to commanded gain, without the ends; a fit ends at the upper one."""
MAX_LEARNED_FRACTION = 1.0 / 3.0
"""Maximum share of the predicted torque's variance that regressors of named signals may have."""

_GAIN_CAUSES = {
    "kp": "q or q_des of another joint, unit or sign; a command column that holds the next state; "
    "commanded gains of another unit",
    "kd": "joints that hardly move; dq that is dead for a while, or of another unit, sign or joint; "
    "commanded gains of another unit",
}
_DELAY_CAUSE = "states and commands of different clocks; a command column that holds the state"
_LEARNED_CAUSE = "a controller that is no PD law; a signal of another joint, unit or sign; a dead signal"


def implausibilities(model: Model, parts: DataSplit) -> Iterator[str]:
    """Check whether a fitted model is that of a PD-controlled joint.

    Args:
        model: The fitted model of J joints.
        parts: Data split.

    Yields:
        One sentence for each implausible property, with its likely causes.
    """
    samples = model.samples
    for name, gains, reference, commanded in zip(
        ("kp", "kd"),
        model.gains,
        samples.reference_gains,
        (samples.commanded, samples.commanded and not samples.undamped),
        strict=True,
    ):
        low, high = GAIN_RATIOS if commanded else (0.0, np.inf)
        wrong = (gains <= low) | (gains >= high)
        if name == "kd" and not commanded:
            wrong = gains < 0.0  # a drive without damping is possible
        if wrong.any():
            each = ", ".join(f"{g * reference:.3g}" for g in np.unique(gains[wrong].round(6)))
            asked = f"{reference:.3g} was commanded" if commanded else "a positive gain is expected"
            yield f"{name} is {each} on {_names(model, wrong)}, but {asked} (likely: {_GAIN_CAUSES[name]})"
    for name, values, most in zip(("input", "output"), model.delays, MAX_DELAYS_S, strict=True):
        # A torque that follows from the motion is a mean over 8 ms, and has no output delay of its own.
        is_defined = name == "input" or not parts.noise_overlap
        if is_defined and (values >= most - 1e-9).any():
            text = f"the {name} delay reaches its bound of {1e3 * most:.0f} ms"
            yield f"{text} (likely: {_DELAY_CAUSE})"
    share = _learned_fraction(model, parts.report)
    if share > MAX_LEARNED_FRACTION:
        yield (
            f"learned terms explain {100.0 * share:.0f} % of the torque, more than a third "
            f"(likely: {_LEARNED_CAUSE})"
        )


def _learned_fraction(model: Model, rows: Bools) -> float:
    """Share of the predicted torque's variance that disappears without the learned regressors."""
    kept = tuple(one for one in model.effects if not isinstance(one.candidate, RegressorCandidate))
    if len(kept) == len(model.effects):
        return 0.0
    torque = model.predict()
    learned = torque - attrs.evolve(model, effects=kept).predict()
    return _variance(learned, rows) / max(_variance(torque, rows), 1e-300)


def _variance(torque: Array, rows: Bools) -> float:
    """Variance about each joint's mean, summed over joints, N^2 m^2."""
    return float(sum(np.var(one[keep]) for one, keep in zip(torque.T, rows.T, strict=True) if keep.any()))


def _names(model: Model, joints: Bools) -> str:
    """Names of some joints, or `all joints`."""
    names = [one for one, chosen in zip(model.samples.joints, joints, strict=True) if chosen]
    return "all joints" if len(names) == len(joints) else ", ".join(names)


def contradictions(report: Mapping[str, Any]) -> Iterator[str]:
    """Check a report for contradictions.

    Args:
        report: Content of report.json.

    Yields:
        One sentence for each contradiction.
    """
    after = report["after"]
    for name, what in (
        ("joint_pd", "a PD law of each joint"),
        ("ridge", f"a ridge regression over {1e3 * FILTER_SPAN_S:.0f} ms"),
    ):
        other = report["baselines"][name]["heldout_mse"]
        left, explained = (report[one]["heldout_mse"] - other for one in ("after", "before"))
        is_worse = left > max((BASELINE_ERROR_RATIO - 1.0) * other, MAX_UNEXPLAINED_SHARE * explained)
        if report["effects"] and is_worse:
            yield (
                f"{what} has a smaller held-out error, {other:.3g} N^2 m^2, than the corrected model, "
                f"{after['heldout_mse']:.3g}: the named effects do not describe the joints"
            )
    share = after.get("heldout_explained")
    if share is not None and share < MIN_EXPLAINED_FRACTION:
        yield (
            f"the corrected model explains {100.0 * share:.0f} % of the torque's variance, less than half: do not use the "
            "named effects before the main cause of the torque is known"
        )
    if after.get("heldout_q_rms_rad", 0.0) > MAX_REPLAY_ERROR_RAD:
        yield (
            f"the replayed commands end {after['heldout_q_rms_rad']:.3g} rad from the measured angles: check the signs, "
            "units and stamps of the log before you use this report"
        )
