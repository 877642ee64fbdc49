"""Checks of the measured torque alone with its command: single rows far off all others, and torque without its sign."""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np
from numpy.typing import NDArray

from .channels import names, rows_of
from .findings import Finding, some
from .log import Array, Bools, Log
from .response import ROUNDING, motion

Numbers = NDArray[np.float64]

LAGS = (0.0, 0.005, 0.01, 0.02, 0.04)
"""s between a command and its torque that are tried."""
BULK = 0.8
"""Share of the rows whose largest deviation gives its scale: up to a tenth of the rows may be spikes, as many at rest."""
FAR = 8.0
"""Standard deviations: normal noise exceeds them in none of 10^15 rows, and torque with ten times as heavy tails in none of 10^5."""
BOTH_WAYS = 0.05
"""Share of the rows in which a signed quantity has the rarer of its signs, where it goes both ways."""
DOWN_TO_ZERO = 0.1
"""Of its usual largest size: what a quantity comes below in one row of twenty where it comes down to 0."""
CLEARLY = 0.9
"""Of the squared error with which a sum of signals explains a quantity: what the size of such a sum has to leave at most."""


def spikes(log: Log) -> Iterator[Finding | Log]:
    """Single rows of the torque that stand far off the rows around and off what command and motion explain."""
    if log.tau is None:
        return
    row = np.arange(len(log.t))
    tau = np.asarray(log.tau, dtype=float)
    level, hit = np.empty_like(tau), np.zeros(tau.shape, bool)
    for j in range(len(log.joints)):
        level[:, j], hit[:, j] = _off(tau[:, j], [_asked(log, row, j, lag) for lag in LAGS])
    if hit.any():
        shares, joints = hit.mean(axis=0), names(log, hit.any(axis=0))
        size = np.max(np.abs(tau - level)[hit])
        text = (
            f"tau: spikes in {100 * shares.max():.2g} % of the rows at most, on {some(joints)}: single rows up to {size:.3g} N m "
            "off the rows around and off what command and motion explain; left out"
        )
        yield Finding("warning", "tau", joints, text)
        yield attrs.evolve(log, tau=np.where(hit, level, tau), valid=log.valid & ~hit)


def _asked(log: Log, row: NDArray[np.intp], j: int, lag: float) -> Numbers:
    """What a PD law makes torque of, (R, 5 or more): command, angle, speed, direction, 1; speed and torque fed forward."""
    sent = log.command_rows(log.t[row] - lag + ROUNDING)
    fed = [x[sent, j] for x in (log.dq_des, log.tau_ff) if x is not None]
    signals = (log.q_des[sent, j], log.q[row, j], *motion(np.asarray(log.dq[row, j], dtype=float)).T, *fed)
    return np.stack(signals, axis=1).astype(float)


def _off(tau: Numbers, laws: list[Numbers]) -> tuple[Numbers, Bools]:
    """The torque with its spikes replaced by the rows around (N,), and which rows these are."""
    hit = np.zeros(len(tau), bool)
    level = tau.copy()
    for _ in range(3):
        around = _around(level)
        alone = _far(tau - around)
        if not alone.any():
            break
        use = ~(hit | alone)
        found = alone & np.all([_far(tau - _explained(law, tau, use)) for law in laws], axis=0)
        level[found & ~hit] = around[found & ~hit]
        if (found & ~hit).sum() == 0:
            break
        hit |= found
    return level, hit


def _around(x: Numbers) -> Numbers:
    """The median of the two rows before and the two after, (N,)."""
    padded = np.pad(x, 2, mode="edge")
    sides = [padded[k : k + len(x)] for k in (0, 1, 3, 4)]
    return np.asarray(np.median(sides, axis=0))


def _far(deviation: Numbers) -> Bools:
    """Rows further than FAR standard deviations off, which are those of a normal distribution with the bulk of the rows."""
    size = np.abs(deviation)
    scale = np.quantile(size, BULK) / 1.28
    return np.asarray(size > FAR * scale + 1e-9)


def _explained(law: Numbers, tau: Numbers, use: Bools) -> Numbers:
    """The torque (N,) that `law` gives, fitted to the rows in `use` without those that it leaves furthest off."""
    for _ in range(3):
        weights = np.linalg.lstsq(law[use], tau[use], rcond=1e-9)[0]
        left = np.abs(tau - law @ weights)
        use = use & (left < FAR * np.quantile(left, BULK) / 1.28 + 1e-9)
    return np.asarray(law @ weights)


def unsigned(values: Array, twin: Array) -> Bools:
    """Joints (J,) whose `values` never change their sign although they come down to 0 and their `twin` has both signs."""
    size = np.abs(values)
    one_way = ((values >= 0.0).all(axis=0) | (values <= 0.0).all(axis=0)) & (np.ptp(values, axis=0) > 0.0)
    touches = np.percentile(size, 5, axis=0) < DOWN_TO_ZERO * np.percentile(size, 95, axis=0)
    scale = 0.1 * np.sqrt(np.mean(twin**2, axis=0))
    both = np.minimum((twin > scale).mean(axis=0), (twin < -scale).mean(axis=0)) > BOTH_WAYS
    return np.asarray(one_way & touches & both)


def is_size(values: Numbers, signals: Numbers, start: Numbers) -> float:
    """Squared error with which the size of a sum of `signals` (N, K) explains `values` (N,), over that of such a sum itself.

    The signs of the sum are those of `start` (N,) first, then those of the sum that explains the values best.
    """
    signed = _sse(values - signals @ np.linalg.lstsq(signals, values, rcond=1e-9)[0])
    sign, least = np.where(start < 0.0, -1.0, 1.0), np.inf
    for _ in range(20):
        total = signals @ np.linalg.lstsq(signals, sign * np.abs(values), rcond=1e-9)[0]
        least = min(least, _sse(np.abs(values) - np.abs(total)))
        before, sign = sign, np.where(total < 0.0, -1.0, 1.0)
        if (sign == before).all():
            break
    return least / (signed + 1e-12)


def _sse(x: Numbers) -> float:
    return float(np.sum(x**2))
