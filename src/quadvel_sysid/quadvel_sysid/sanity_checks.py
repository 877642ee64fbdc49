"""What in a report contradicts itself, in sentences for the terminal: results that nobody should act on unread."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from .baselines import FILTER_SPAN_S

FAR = 1.0
"""rad; a replay that strays so far from the measured angles shows nothing of the model."""
HALF = 0.5
"""Share of the torque's variance that a model explains at least where the torque is that of the drive."""
WORTH = 1.05
"""Times the error of what needs no model, below which a model is as good."""


def contradictions(report: Mapping[str, Any]) -> Iterator[str]:
    """Sentences about a report with the fields of report.json."""
    after = report["after"]
    for name, what in (
        ("joint_pd", "a PD law of each joint"),
        ("ridge", f"a ridge regression over {1e3 * FILTER_SPAN_S:.0f} ms"),
    ):
        other = report["baselines"][name]["heldout_mse"]
        if after["heldout_mse"] > WORTH * other:
            yield (
                f"{what} leaves less of the held-out torque, {other:.3g} N^2 m^2, than the corrected model, "
                f"{after['heldout_mse']:.3g}: what was named is not what the joints do"
            )
    share = after.get("heldout_explained")
    if share is not None and share < HALF:
        yield (
            f"the corrected model explains {100.0 * share:.0f} % of the torque's variance, less than half: what moves it "
            "is not known, and what was named is not to be trusted before it is"
        )
    if after.get("heldout_q_rms_rad", 0.0) > FAR:
        yield (
            f"replayed, the commands lead {after['heldout_q_rms_rad']:.3g} rad away from the measured angles: look at the signs, "
            "units and stamps of the log before believing anything else here"
        )
