"""What is computed on: logs that are too long as pieces spread over them, and stamps that arrived late set right.

Receive times of messages that were sent at an even rate jitter; where a log's stamps do, its evenly sent times are
restored and `identify` takes whichever explains the torque better.
"""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from .log import Array, Log, LogError

PIECE = 0.75  # s: many short pieces of a long log show more of what it does than few long ones
LEAST = 50, 10  # rows of states, of commands, that a piece holds
SPARE = 1.2  # times these at the usual rate: a few rows may be lost
LEAD = 0.1  # s of commands before a piece
JITTER = 0.03
"""Spacing that varies by more than this share of the usual one counts as jitter."""

_OF_COMMANDS = ("t_cmd", "q_des", "dq_des", "tau_ff", "kp", "kd")
_FEWEST, _REPEATED = 50, 0.7  # commands, and share of the rows that hold a new one: at least, at most
_WINDOW = 101, 31  # rows of states, of commands, over which lateness is a drift and not jitter
_REACH = 200  # rows from which the true period is read


def pieces(log: Log, seconds: float, between: bool = False) -> list[Log]:
    """The log, or stretches of it of some `seconds` in all that are spread evenly; or those between these.

    Raises LogError where none of these holds LEAST rows.
    """
    if log.duration <= seconds:
        return [log]
    usual = log.period, float(np.median(np.diff(log.t_cmd)))
    length = max(PIECE, *(SPARE * least * period for least, period in zip(LEAST, usual, strict=True)))
    count = max(int(seconds / length), 1)
    places = np.linspace(float(log.t[0]), float(log.t[-1]) - length, max(2 * count - 1, 2))
    starts = places[1::2] if between else places[::2]
    found = [one for start in starts if (one := _cut(log, start, start + length)) is not None]
    if not found:
        raise LogError(
            f"{log.name}: t, t_cmd: none of the {len(starts)} stretches of {length:.3g} s that were looked at holds "
            f"{LEAST[0]} rows and {LEAST[1]} commands, expected a log with fewer gaps"
        )
    return found


def _cut(log: Log, start: float, stop: float) -> Log | None:
    rows = slice(*np.searchsorted(log.t, [start, stop]))
    first, last = np.searchsorted(log.t_cmd, [start - LEAD, stop])
    sent = slice(max(int(first) - 1, 0), int(last))
    taken: dict[str, Any] = {}
    for field in attrs.fields(Log):
        value = getattr(log, field.name)
        if isinstance(value, np.ndarray):
            of_it = sent if field.name in _OF_COMMANDS else rows
            taken[field.name] = value[of_it].copy()  # a view would hold the whole
    if len(taken["t"]) < LEAST[0] or len(taken["t_cmd"]) < LEAST[1]:
        return None
    return attrs.evolve(log, began=float(log.t[0]), **taken)


def jitters(log: Log) -> bool:
    """Do the stamps of states or commands vary more than an even clock's?"""
    return any(_jitter(time) > JITTER for time in (log.t, _sent(log).t_cmd))


def evened(log: Log) -> Log:
    """The log with the stamps of an even sender; losses and slow drifts stay."""
    log = _sent(log)
    t, t_cmd = (_even(time, window) for time, window in zip((log.t, log.t_cmd), _WINDOW, strict=True))
    return attrs.evolve(log, t=t, t_cmd=t_cmd)


def _sent(log: Log) -> Log:
    """The log with each command once, where they stand in the rows of states and most rows repeat the one before.

    Then a row is all that is known of when one was sent.
    """
    if len(log.t_cmd) != len(log.t) or (log.t_cmd != log.t).any():
        return log
    fields = {name: getattr(log, name) for name in _OF_COMMANDS if getattr(log, name) is not None}
    new = np.any(
        [(np.diff(fields[name], axis=0) != 0.0).any(axis=1) for name in fields if name != "t_cmd"], axis=0
    )
    rows = np.concatenate([[0], 1 + np.flatnonzero(new)])
    if not _FEWEST <= len(rows) <= _REPEATED * len(log.t):
        return log
    return attrs.evolve(log, **{name: values[rows] for name, values in fields.items()})


def _jitter(time: NDArray[np.floating]) -> float:
    steps = np.diff(time)
    low, usual, high = np.percentile(steps, [10, 50, 90])
    return float((high - low) / usual)


def _even(time: NDArray[np.floating], window: int) -> Array:
    reach = min(_REACH, len(time) // 3)
    if reach < 20 or _jitter(time) <= JITTER:
        return time
    period = float(np.median(time[reach:] - time[:-reach])) / reach
    clock = period * np.arange(len(time))
    even: Array = clock + median_filter(np.asarray(time - clock, dtype=float), window, mode="nearest")
    least = 1e-4 * period  # a clock that steps back would be no clock
    rising: Array = np.maximum.accumulate(even) + least * np.arange(len(even)) / len(even)
    return rising
