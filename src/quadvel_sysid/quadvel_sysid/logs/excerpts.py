"""Excerpts of long logs, and correction of jittering time stamps.

Receive times of messages that were sent at an even rate jitter. `restore_even_clock` estimates
the send times; identification uses whichever times explain the torque better.
"""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
from scipy.ndimage import median_filter

from quadvel_description.arrays import Floats

from .log import Log, LogError

PIECE_S = 0.75
"""s; many short excerpts of a long log show more of its motion than few long ones."""
MIN_PIECE_ROWS = 50, 10
"""Fewest rows of states, and of commands, of an excerpt."""
ROW_RESERVE = 1.2
"""Times `MIN_PIECE_ROWS` at the usual rate, since a few rows may be lost."""
COMMAND_LEAD_S = 0.1
"""s of commands before an excerpt."""
MIN_JITTER = 0.03
"""Range of the spacing (10th to 90th percentile) over its median, above which times jitter."""

_COMMAND_FIELDS = ("t_cmd", "q_des", "dq_des", "tau_ff", "kp", "kd")
_MIN_COMMANDS, _MAX_NEW_SHARE = 50, 0.7
"""Fewest distinct commands, and largest share of the rows that hold a new one."""
_DRIFT_ROWS = 101, 31
"""Rows of states, and of commands, over which a deviation is a drift and not jitter."""
_PERIOD_ROWS = 200
"""Rows over which the true period is estimated."""


def cut_excerpts(log: Log, seconds: float) -> list[Log]:
    """Cut excerpts out of a log, spread evenly over its length.

    Args:
        log: The log.
        seconds: Total duration of the excerpts, s; a log that is no longer is returned whole.

    Returns:
        The excerpts.

    Raises:
        LogError: No excerpt holds `MIN_PIECE_ROWS`.
    """
    if log.duration <= seconds:
        return [log]
    usual = log.period, float(np.median(np.diff(log.t_cmd)))
    length = max(
        PIECE_S, *(ROW_RESERVE * least * period for least, period in zip(MIN_PIECE_ROWS, usual, strict=True))
    )
    count = max(int(seconds / length), 1)
    starts = np.linspace(float(log.t[0]), float(log.t[-1]) - length, max(2 * count - 1, 2))[::2]
    found = [one for start in starts if (one := _cut(log, start, start + length)) is not None]
    if not found:
        raise LogError(
            f"{log.name}: t, t_cmd: none of the {len(starts)} excerpts of {length:.3g} s holds "
            f"{MIN_PIECE_ROWS[0]} rows and {MIN_PIECE_ROWS[1]} commands, expected a log with fewer gaps"
        )
    return found


def _cut(log: Log, start: float, stop: float) -> Log | None:
    """Copy the rows from `start` to `stop` (s); None if they are too few."""
    rows = slice(*np.searchsorted(log.t, [start, stop]))
    first, last = np.searchsorted(log.t_cmd, [start - COMMAND_LEAD_S, stop])
    sent = slice(max(int(first) - 1, 0), int(last))
    selected: dict[str, Any] = {}
    for field in attrs.fields(Log):
        value = getattr(log, field.name)
        if isinstance(value, np.ndarray):
            kept = sent if field.name in _COMMAND_FIELDS else rows
            selected[field.name] = value[kept].copy()  # a view would keep the whole array
    if len(selected["t"]) < MIN_PIECE_ROWS[0] or len(selected["t_cmd"]) < MIN_PIECE_ROWS[1]:
        return None
    return attrs.evolve(log, recording_start=float(log.t[0]), **selected)


def has_jitter(log: Log) -> bool:
    """Test whether the stamps of states or commands jitter.

    Args:
        log: The log.

    Returns:
        True if the spacing of one of them varies by more than `MIN_JITTER`.
    """
    return any(_jitter(time) > MIN_JITTER for time in (log.t, _distinct_commands(log).t_cmd))


def restore_even_clock(log: Log) -> Log:
    """Replace jittering stamps by those of an evenly sending clock; losses and slow drifts stay.

    Args:
        log: The log.

    Returns:
        The log with new times `t` and `t_cmd`.
    """
    log = _distinct_commands(log)
    t, t_cmd = (
        _even_times(time, window) for time, window in zip((log.t, log.t_cmd), _DRIFT_ROWS, strict=True)
    )
    return attrs.evolve(log, t=t, t_cmd=t_cmd)


def _distinct_commands(log: Log) -> Log:
    """Keep each command once, if commands are logged in the rows of states and most rows repeat one.

    The row in which a command first appears is all that is known about its send time.
    """
    if len(log.t_cmd) != len(log.t) or (log.t_cmd != log.t).any():
        return log
    fields = {name: getattr(log, name) for name in _COMMAND_FIELDS if getattr(log, name) is not None}
    new = np.any(
        [(np.diff(fields[name], axis=0) != 0.0).any(axis=1) for name in fields if name != "t_cmd"], axis=0
    )
    rows = np.concatenate([[0], 1 + np.flatnonzero(new)])
    if not _MIN_COMMANDS <= len(rows) <= _MAX_NEW_SHARE * len(log.t):
        return log
    return attrs.evolve(log, **{name: values[rows] for name, values in fields.items()})


def _jitter(time: Floats) -> float:
    """Range of the spacing (10th to 90th percentile) over its median."""
    steps = np.diff(time)
    low, usual, high = np.percentile(steps, [10, 50, 90])
    return float((high - low) / usual)


def _even_times(time: Floats, window: int) -> Floats:
    """Times of an even clock plus its drift, a median-filtered deviation from a uniform clock."""
    reach = min(_PERIOD_ROWS, len(time) // 3)
    if reach < 20 or _jitter(time) <= MIN_JITTER:
        return time
    # Model t_n = T n + drift_n + jitter_n. The period T comes from differences over many rows, the
    # drift from a median filter of t_n - T n.
    period = float(np.median(time[reach:] - time[:-reach])) / reach
    clock = period * np.arange(len(time))
    even: Floats = clock + median_filter(np.asarray(time - clock, dtype=float), window, mode="nearest")
    least = 1e-4 * period  # keeps the times strictly increasing
    rising: Floats = np.maximum.accumulate(even) + least * np.arange(len(even)) / len(even)
    return rising
