"""Which times count in a recording: the stamps of its messages, or when these were received."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Nanoseconds = NDArray[np.int64]

FROM_ZERO = 10_000_000_000
"""ns: a clock whose first stamp after 0 is no later began at 0 itself, as simulated time does."""


def stamp_of(message: Any) -> int | None:
    """The stamp of a message, ns, or None for a type that has none."""
    stamp = getattr(getattr(message, "header", message), "stamp", None)
    return None if stamp is None else stamp.sec * 10**9 + stamp.nanosec


def missing(stamps: Nanoseconds) -> int:
    """How many stamps (n,), ns, are 0 although their clock does not begin there."""
    there = stamps[stamps > 0]
    from_zero = there.size > 0 and there.min() <= FROM_ZERO
    return 0 if from_zero else int((stamps == 0).sum())


def unstamped(stamps: Mapping[str, Nanoseconds]) -> list[str]:
    """A sentence for each topic on which stamps are missing: then the times of receipt count for all topics."""
    found = {topic: missing(times) for topic, times in stamps.items()}
    return [
        f"{topic}: {count} of {len(stamps[topic])} stamps are 0; the times of receipt are used instead of all stamps"
        for topic, count in found.items()
        if count
    ]
