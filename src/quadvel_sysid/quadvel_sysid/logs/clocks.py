"""Are states and commands on one clock? The lag from command to torque that explains the torque best, of all within seconds.

At each lag l the torque of a joint is regressed on what a PD law can ask for at that lag,

    tau(t) = a q_des(t - l) + b dq_des(t - l) + c tau_ff(t - l) + d q(t) + e dq(t) + f sign(dq(t)) + g,

with the slope of q_des where dq_des is not logged, as a drive may feed it forward. The sums over the rows that overlap are
correlations, so that Fourier transforms give them for all lags at once. Without torque, the acceleration stands for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from .findings import Finding
from .log import Log
from .response import BETTER, CLEAR, REACH, ROUNDING, motion

Numbers = NDArray[np.float64]

STEP = 0.002
"""s between the lags, a row of the log at least."""
FAR = 10.0
"""s, the longest lag to either side; half of the log at most."""
MOST_ROWS = 30_000
"""Rows used, from the middle of a long log: a minute at STEP."""
LATEST = 0.045
"""s, the longest delay of a drive: the model has 26 ms at most, and rows at 50 Hz add up to 20 ms."""
LEAD = 0.2
"""s, the largest kd / kp with which a drive feeds the speed of its command forward."""
STANDARD_ERRORS = 4.0
"""By which another lag must explain more than those of a drive: in a healthy log chance does that once in 30,000."""
PIECE = 0.1
"""s of motion that count as one piece of evidence."""
SLOW = 0.25
"""s, within which an acceleration may lead or follow the command that it answers: its springs and friction are not known."""
HALF_WIDTH = 0.01
"""s to either side over which the slope of dq is taken."""


@attrs.frozen(eq=False)
class _Joint:
    """Signals of one joint at N instants, evenly spaced; `fixed` ends with 1, and belongs to the torque's instant."""

    torque: Numbers  # (N,)
    fixed: Numbers  # (N, K): angle, speed, direction, 1
    moving: Numbers  # (N, C): q_des, its speed, and tau_ff where there is one
    use: Numbers  # (N,), 1 where the row counts
    sent: Numbers  # (N,), 1 where a command was in force

    def left(self, most: int) -> Numbers:
        """(2 most + 1,), the share of the torque's variance that commands leave which are `-most` to `most` rows late."""
        products = self._products(most)
        one, command, speed = self.fixed.shape[1] - 1, self.fixed.shape[1], self.fixed.shape[1] + 1
        variance = products[:, -1, -1] - products[:, -1, one] ** 2 / (products[:, one, one] + 1e-12)
        every = np.arange(products.shape[1] - 1)
        plain, _ = _regressed(products, np.delete(every, speed))
        fed, weights = _regressed(products, every)
        causal = _causal(weights[:, command], weights[:, speed])
        return np.asarray(np.where(causal, np.minimum(plain, fed), plain) / (variance + 1e-12))

    def _products(self, most: int) -> Numbers:
        """(L, P, P), for each lag the products of `fixed`, `moving` and `torque`, summed over the rows that overlap."""
        rows, still, sent = len(self.torque), self.fixed.shape[1], self.moving.shape[1]
        here = np.column_stack([self.fixed, np.ones((rows, sent)), self.torque])
        there = np.column_stack([np.ones((rows, still)), self.moving, np.ones(rows)])
        a, b = np.triu_indices(here.shape[1])
        length = fft.next_fast_len(rows + most + 1, real=True)
        spectra = (
            fft.rfft((weight[:, None] * columns[:, a] * columns[:, b]).T, length)
            for weight, columns in ((self.use, here), (self.sent, there))
        )
        first, second = spectra
        sums = fft.irfft(first * np.conj(second), length)
        found = np.empty((2 * most + 1, here.shape[1], here.shape[1]))
        found[:, a, b] = found[:, b, a] = np.concatenate([sums[:, -most:], sums[:, : most + 1]], axis=1).T
        return found

    def errors(self, late: int) -> Numbers:
        """(N,), squared error of the torque over its variance with commands `late` rows late, 0 where they are not known."""
        row = np.arange(len(self.torque)) - late
        known = (row >= 0) & (row < len(row))
        row = np.clip(row, 0, len(row) - 1)
        weight = self.use * self.sent[row] * known
        signals = np.column_stack([self.fixed, self.moving[row]]) * weight[:, None]
        torque, command = self.torque * weight, self.fixed.shape[1]
        weights = np.linalg.lstsq(signals, torque, rcond=1e-9)[0]
        if not _causal(weights[command], weights[command + 1]):
            signals[:, command + 1] = 0.0
            weights = np.linalg.lstsq(signals, torque, rcond=1e-9)[0]
        variance = float(np.var(self.torque[weight > 0.0])) + 1e-12
        return np.asarray((torque - signals @ weights) ** 2 / variance)


def _causal(of_command: Any, of_speed: Any) -> Any:
    """Does a drive feed the speed forward with these weights, so that its torque leads its command by 0 to LEAD?"""
    return (of_command * of_speed >= 0.0) & (np.abs(of_speed) <= LEAD * np.abs(of_command))


def _regressed(products: Numbers, columns: NDArray[np.intp]) -> tuple[Numbers, Numbers]:
    """What a regression of the last column on `columns` leaves, (L,), and its weights (L, P - 1), 0 of the others."""
    inner, outer = products[:, columns[:, None], columns], products[:, columns, -1]
    size = np.sqrt(np.maximum(np.einsum("lkk->lk", inner), 1e-12))
    inner = inner / size[:, :, None] / size[:, None, :] + 1e-9 * np.eye(len(columns))
    weights = np.zeros((len(products), products.shape[1] - 1))
    weights[:, columns] = np.linalg.solve(inner, (outer / size)[..., None])[..., 0] / size
    left = products[:, -1, -1] - np.sum(weights[:, columns] * outer, axis=1)
    return np.maximum(left, 0.0), weights


@attrs.frozen(eq=False)
class Lags:
    """What commands of each lag explain of the torque of a log's joints, on instants `step` s apart."""

    step: float
    most: int  # steps to either side
    joints: tuple[_Joint, ...]

    @cached_property
    def lags(self) -> Numbers:
        """(L,), from a command to its torque, s."""
        return np.asarray(self.step * np.arange(-self.most, self.most + 1), dtype=np.float64)

    @cached_property
    def left(self) -> Numbers:
        """(L, J), share of each joint's torque that is left."""
        return np.stack([one.left(self.most) for one in self.joints], axis=1)

    @cached_property
    def total(self) -> Numbers:
        """(L,), geometric mean over the joints."""
        return np.asarray(np.exp(np.mean(np.log(self.left + 1e-6), axis=1)), dtype=np.float64)

    def standard_errors(self, lag: int, other: int) -> float:
        """By how many the lag of index `lag` explains more than that of index `other`, in pieces of PIECE."""
        gains = [one.errors(other - self.most) - one.errors(lag - self.most) for one in self.joints]
        gain = np.sum(gains, axis=0)
        pieces = np.add.reduceat(gain, np.arange(0, len(gain), max(1, round(PIECE / self.step))))
        return float(pieces.sum() / np.sqrt(np.sum((pieces - pieces.mean()) ** 2) + 1e-12))


def lags_of(log: Log) -> Lags | None:
    """None where too few rows count."""
    step = max(STEP, log.period)
    t = np.arange(log.t[0], log.t[-1], step)
    t = t[max(0, len(t) - MOST_ROWS) // 2 :][:MOST_ROWS]
    row, command = np.searchsorted(log.t, t + ROUNDING, side="right") - 1, log.command_rows(t)
    moving = np.flatnonzero(log.valid[row].any(axis=0) & (np.ptp(log.q_des[command], axis=0) > 0.0))
    if log.valid[row].any(axis=1).sum() < 50 or not len(moving):
        return None
    sent = np.asarray(t >= log.t_cmd[0], dtype=float)
    joints = tuple(_joint(log, int(j), row, command, sent, step) for j in moving)
    return Lags(step, int(min(FAR, step * len(t) / 2) / step), joints)


def _joint(
    log: Log, j: int, row: NDArray[np.intp], command: NDArray[np.intp], sent: Numbers, step: float
) -> _Joint:
    q, dq = (np.asarray(x[row, j], dtype=float) for x in (log.q, log.dq))
    q_des = np.asarray(log.q_des[command, j], dtype=float) - q.mean()
    reach = max(1, round(HALF_WIDTH / step))
    torque = _slope(dq, reach, step) if log.tau is None else np.asarray(log.tau[row, j], dtype=float)
    speed = np.gradient(q_des, step) if log.dq_des is None else log.dq_des[command, j]
    asked = [q_des, speed, *([] if log.tau_ff is None else [log.tau_ff[command, j]])]
    return _Joint(
        torque - torque.mean(),
        np.column_stack([q - q.mean(), motion(dq)]),
        np.column_stack(asked).astype(float),
        log.valid[row, j].astype(float),
        sent,
    )


def _slope(x: Numbers, reach: int, step: float) -> Numbers:
    first, last = np.maximum(np.arange(len(x)) - reach, 0), np.minimum(np.arange(len(x)) + reach, len(x) - 1)
    return np.asarray((x[last] - x[first]) / ((last - first) * step))


def clock(log: Log) -> Iterator[Finding]:
    """Torque (without it, motion) that answers commands of a lag that no drive has: t and t_cmd are not of one clock."""
    found = lags_of(log)
    if found is None:
        return
    earliest, latest = (0.0, LATEST) if log.tau is not None else (-SLOW, SLOW)
    of_a_drive = (found.lags > earliest - STEP / 2) & (found.lags < latest + STEP / 2)
    best = int(np.argmin(found.total))
    usual = int(np.argmin(np.where(of_a_drive, found.total, np.inf)))
    lag, left, other = float(found.lags[best]), float(found.total[best]), float(found.total[usual])
    ratio = CLEAR if latest < lag <= SLOW else BETTER
    if of_a_drive[best] or left > min(ratio * other, CLEAR):
        return
    if found.standard_errors(best, usual) < STANDARD_ERRORS:
        return
    what = "torque" if log.tau is not None else "motion"
    shares = (
        f"that leaves {100 * left:.2g} % of the {what}, a delay that a drive can have {100 * other:.2g} %"
    )
    if -REACH <= lag < 0.0:
        text = (
            f"t_cmd: the {what} comes {-1e3 * lag:.0f} ms before its command ({shares}); expected each command at the time it "
            "was sent: is it logged a step late?"
        )
    else:
        way = (
            f"{lag:.2f} s after they were sent, more than a drive can be late"
            if lag > 0.0
            else f"{-lag:.2f} s before they were sent"
        )
        text = f"t_cmd: the {what} answers commands {way} ({shares}): t and t_cmd are not of one clock; expected one for both"
    yield Finding("refusal", "t_cmd", (), text)
