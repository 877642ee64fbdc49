"""Held-out data where no log was named for it: contiguous blocks of each log, spread over all of its motion."""

from __future__ import annotations

import attrs
import numpy as np

from .log import Bools, Log

BLOCKS = 16
EVERY = 4
"""One block of so many is kept aside."""
APART = (
    0.05  # s, before a held-out block and after it, that neither side uses: neighbouring samples are alike
)


def split(log: Log) -> tuple[Log, Log]:
    """The log to fit and the log to judge on: the same rows, `valid` on different ones.

    Blocks hold equally many valid rows each, so that a stretch that is left out costs neither side its share.
    """
    used = log.valid.any(axis=1)
    block = np.minimum(BLOCKS * (np.cumsum(used) - used) // max(1, int(used.sum())), BLOCKS - 1)
    held: Bools = block % EVERY == EVERY // 2
    near = _near(held, log)
    train = log.valid & ~(held | near)[:, None]
    return attrs.evolve(log, valid=train), attrs.evolve(log, valid=log.valid & held[:, None])


def _near(held: Bools, log: Log) -> Bools:
    """Rows less than APART from a held-out one."""
    times = log.t[held]
    after = np.searchsorted(times, log.t)
    ahead = np.abs(times[np.minimum(after, len(times) - 1)] - log.t)
    behind = np.abs(log.t - times[np.maximum(after - 1, 0)])
    near: Bools = np.minimum(ahead, behind) < APART
    return near
