"""Sanity checks of a report: results that must not be used without inspection."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ..statistics.baselines import FILTER_SPAN_S

MAX_REPLAY_ERROR_RAD = 1.0
"""Replay error, rad, above which a replay is no evidence for the model."""
MIN_EXPLAINED_FRACTION = 0.5
"""Minimum fraction of the torque's variance that a valid model explains."""
BASELINE_ERROR_RATIO = 1.05
"""Error ratio to a baseline above which the model is worse than the baseline."""


def contradictions(report: Mapping[str, Any]) -> Iterator[str]:
    """Check a report for contradictions.

    Args:
        report: Content of report.json.

    Yields:
        One warning for each contradiction.
    """
    after = report["after"]
    for name, what in (
        ("joint_pd", "a PD law of each joint"),
        ("ridge", f"a ridge regression over {1e3 * FILTER_SPAN_S:.0f} ms"),
    ):
        other = report["baselines"][name]["heldout_mse"]
        if after["heldout_mse"] > BASELINE_ERROR_RATIO * other:
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
