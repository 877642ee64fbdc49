"""Checks of the time stamps: units, clocks that were set forward, rates, gaps and lost rows.

`Log` itself refuses times that do not rise.
"""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np

from ..findings import Finding
from ..log import GAP_FACTOR, Log

COMMAND_GAP_S = 0.1
"""s without a command that make a gap in a regular stream of commands."""
MAX_GAP_S = 86_400.0
"""s; a longer step means that the clock was set forward."""
MAX_SPAN_RATIO = 30.0
"""Span of the commands over that of the states, above which they have different units or recordings."""
MAX_PERIOD_S, MIN_PERIOD_S = 0.5, 1e-5
"""s between two rows, from `MIN_PERIOD_S` to `MAX_PERIOD_S`; another spacing means another unit of
time.
"""

BURST_STEP = 0.1
"""Steps below this share of the mean step belong to a burst: one read of a buffer that held several rows."""
MIN_BURST_SHARE = 0.3
"""Share of such steps from which a log was stamped when a buffer was read; a slow receiver alone has fewer."""


def bursts(log: Log) -> Iterator[Finding | Log]:
    """Rows that follow each other at once: stamps of reading a buffer, not of measuring.

    Args:
        log: The log to check.

    Yields:
        The log with the rows of each burst spread over the time since the burst before, and a warning.
    """
    steps = np.diff(log.t)
    regular = steps[steps < GAP_FACTOR * np.percentile(steps, 95)]
    period = float(regular.mean())
    share = float(np.mean(steps < BURST_STEP * period))
    if share < MIN_BURST_SHARE:
        return
    # The last row of a burst was measured when it was read. Its m rows were measured every period
    # before, but after the last burst: t_k = start + (end - start) (k + 1) / m.
    last = np.append(np.flatnonzero(steps >= BURST_STEP * period), len(log.t) - 1)
    size = np.diff(last, prepend=-1)
    end = log.t[last]
    start = np.maximum(np.append(-np.inf, end[:-1]), end - size * period)
    within = np.arange(len(log.t)) - np.repeat(last - size, size)
    t = np.repeat(start, size) + np.repeat((end - start) / size, size) * within
    text = (
        f"t: {share:.0%} of the rows come at once after the row before, as if a buffer of {size.max()} rows was read; "
        "they are spread over the time since the last read"
    )
    yield Finding("warning", "t", (), text)
    yield attrs.evolve(log, t=t, t_cmd=log.t_cmd if log.has_own_command_stamps else t)


def time_bases(log: Log) -> Iterator[Finding]:
    """Clocks that were set during the log, have another unit, or nothing in common.

    Args:
        log: The log to check.

    Yields:
        Refusals.
    """
    period = log.period
    if not MIN_PERIOD_S <= period <= MAX_PERIOD_S:
        unit = "milliseconds, microseconds or nanoseconds" if period > MAX_PERIOD_S else "hours"
        text = f"t: a row comes every {period:.4g} s; is t in {unit}? expected seconds"
        yield Finding("refusal", "t", (), text)
        return
    for field, time in (("t", log.t), ("t_cmd", log.t_cmd)):
        row = int(np.argmax(np.diff(time)))
        step = float(time[row + 1] - time[row])
        if step > max(MAX_GAP_S, 1e3 * float(np.median(np.diff(time)))):
            text = (
                f"{field}: jumps by {step:.6g} s from row {row} to row {row + 1}; expected one clock, in seconds: "
                "was it set while this was recorded?"
            )
            yield Finding("refusal", field, (), text)
    spans = f"t_cmd: {log.t_cmd[0]:.6g} to {log.t_cmd[-1]:.6g} s, t: {log.t[0]:.6g} to {log.t[-1]:.6g} s"
    ratio = (log.t_cmd[-1] - log.t_cmd[0]) / (log.t[-1] - log.t[0])
    if log.t_cmd[0] > log.t[-1] or log.t_cmd[-1] < log.t[0]:
        yield Finding("refusal", "t_cmd", (), f"{spans}: nothing in common, expected one clock for both")
    elif ratio > MAX_SPAN_RATIO:
        text = f"{spans}: {ratio:.3g} times as long, expected both in seconds and of the same recording"
        yield Finding("refusal", "t_cmd", (), text)


def sampling_rates(log: Log) -> Iterator[Finding]:
    """Rate, jitter, gaps and lost rows of both time bases.

    Args:
        log: The log to check.

    Yields:
        Notes and warnings.
    """
    for field, time in (("t", log.t), ("t_cmd", log.t_cmd)):
        if field == "t_cmd" and time is log.t:
            continue
        steps = np.diff(time)
        low, usual, high = (float(x) for x in np.percentile(steps, [5, 50, 95]))
        text = (
            f"{field}: {len(time)} rows over {time[-1] - time[0]:.2f} s, {1 / usual:.4g} Hz; "
            f"spacing {1e3 * low:.2f} to {1e3 * high:.2f} ms (5 to 95 %), at most {1e3 * steps.max():.2f} ms"
        )
        yield Finding("note", field, (), text)
        regular = high < 2.0 * usual
        gaps = np.flatnonzero(steps > max(GAP_FACTOR * usual, COMMAND_GAP_S if field == "t_cmd" else 0.0))
        if gaps.size and (regular or field == "t"):
            longest = int(gaps[np.argmax(steps[gaps])])
            text = (
                f"{field}: {gaps.size} gap{'s' * (gaps.size > 1)}, the longest of {steps[longest]:.3f} s "
                f"at {time[longest]:.2f} s"
            )
            yield Finding("warning", field, (), text)
        missing = int(np.sum(np.round(steps[steps < GAP_FACTOR * usual] / usual) - 1.0)) if regular else 0
        if missing > 0.001 * len(time):
            text = f"{field}: about {missing} rows were dropped, one at a time"
            yield Finding("warning", field, (), text)
    if log.t_cmd[-1] < log.t[-1] - COMMAND_GAP_S:
        late = log.t[-1] - log.t_cmd[-1]
        text = (
            f"t_cmd: the last command came {late:.2f} s before the last state; it is assumed to stay in force"
        )
        yield Finding("warning", "t_cmd", (), text)
