"""Choice between the stamps of messages and their times of receipt."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Nanoseconds = NDArray[np.int64]

MAX_SIM_START_NS = 10_000_000_000
"""Latest first stamp, ns, of a clock that started at 0, as simulated time does."""


def stamp_of(message: Any) -> int | None:
    """Return the stamp of a message.

    Args:
        message: A message with a `stamp` or `header.stamp`, or without.

    Returns:
        The stamp, ns, or None if the type has none.
    """
    stamp = getattr(getattr(message, "header", message), "stamp", None)
    return None if stamp is None else stamp.sec * 10**9 + stamp.nanosec


def count_missing(stamps: Nanoseconds) -> int:
    """Count the stamps that are 0 although the clock did not start at 0.

    Args:
        stamps: (n,), ns.

    Returns:
        The number of missing stamps.
    """
    there = stamps[stamps > 0]
    from_zero = there.size > 0 and there.min() <= MAX_SIM_START_NS
    return 0 if from_zero else int((stamps == 0).sum())


def missing_stamp_notices(stamps: Mapping[str, Nanoseconds]) -> list[str]:
    """Describe the topics with missing stamps, for which all times must be times of receipt.

    Args:
        stamps: (n,), ns, by topic.

    Returns:
        One sentence for each topic with missing stamps.
    """
    found = {topic: count_missing(times) for topic, times in stamps.items()}
    return [
        f"{topic}: {count} of {len(stamps[topic])} stamps are 0; the times of receipt are used instead of all stamps"
        for topic, count in found.items()
        if count
    ]
