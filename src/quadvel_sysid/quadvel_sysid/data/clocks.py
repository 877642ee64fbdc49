"""Clocks of recordings: jittering stamps, and the offset between the clocks of states and commands.

Both belong to a recording, not to the robot. They are chosen by the torque error of the plain model
(`plain_model`: PD gains and two delays), on rows that do not enter the reported error.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from scipy import stats

from quadvel_description.arrays import Array, Bools, Indices

from ..logs.excerpts import has_jitter, restore_even_clock
from ..logs.findings import Finding
from ..logs.log import Log
from ..options import SearchOptions
from .dataset import Dataset
from .plain_model import Eam, fit_eam
from .signals import Samples
from .split import cluster_starts, reported_rows

_SIGNIFICANCE_LEVEL = 0.01
"""Significance level of the tests that change the stamps of a recording."""
_MAX_OFFSET_S = 0.004
_OFFSET_STEPS_S = (0.0005, 0.00005)
"""Largest offset of the clocks, and steps of the coarse and the fine grid, s."""
_JACKKNIFE_GROUPS = 10


@attrs.frozen
class RecordingClock:
    """Clock of one recording.

    Attributes:
        log: Name of the recording.
        heldout: Whether it is held out.
        even: Whether evenly spaced stamps, as the sender's clock gave them, replace jittering ones.
        offset_s: Delay of its commands relative to the mean of the fitted recordings, s; its command
            stamps were shifted by it. None if commands and states have the same stamps.
        half_width_s: Half width of the 95 % interval of the offset, s.
    """

    log: str
    heldout: bool
    even: bool
    offset_s: float | None = None
    half_width_s: float = 0.0


def known_offsets(clocks: Sequence[RecordingClock]) -> tuple[float, ...]:
    """Return the offsets of the recordings' commands that are known.

    Args:
        clocks: Clock of each recording.

    Returns:
        Offsets, s.
    """
    return tuple(one.offset_s for one in clocks if one.offset_s is not None)


def choose_stamps(
    dataset: Dataset, windows: Sequence[float], length: float, options: SearchOptions
) -> tuple[Dataset, list[RecordingClock]]:
    """Decide for each recording whether jittering stamps are replaced by those of an even clock.

    They are replaced if the plain model then predicts the recording's torque significantly better,
    in a one-sided t test over clusters of its rows at the level 0.01.

    Args:
        dataset: The logs.
        windows: Windows (s) to try in the plain model, over which the drive averages commands.
        length: Length of the blocks of rows, s.
        options: Options of the search.

    Returns:
        The logs with the chosen stamps, and the clock of each recording.
    """
    stamped, clocks = list(dataset.logs), []
    for recording, pieces in enumerate(dataset.pieces):
        mine = [stamped[k] for k in pieces]
        even = [restore_even_clock(log) for log in mine]
        jitters = options.even_clocks and any(has_jitter(log) for log in mine)
        is_even = jitters and _is_better(
            *(_errors(logs, dataset, recording, windows, length) for logs in (mine, even))
        )
        if is_even:
            for k, log in zip(pieces, even, strict=True):
                stamped[k] = log
        clocks.append(RecordingClock(mine[0].name, dataset.is_heldout(recording), is_even))
    return dataset.with_logs(stamped), clocks


def align_commands(
    dataset: Dataset, clocks: Sequence[RecordingClock], windows: Sequence[float], length: float
) -> tuple[Dataset, list[RecordingClock]]:
    """Shift the command stamps of each recording by the offset between its clocks.

    Total delays differ between recordings of one robot, as states and commands are stamped by
    different computers. Offsets are relative to the mean of the fitted recordings.

    Args:
        dataset: The logs.
        clocks: Clock of each recording.
        windows: Windows (s) to try in the plain model, over which the drive averages commands.
        length: Length of the blocks of rows, s.

    Returns:
        The aligned logs, and the clocks with their offsets. If the 95 % interval of an offset
        contains 0, the clock states the offset, but no stamp is shifted by it.
    """
    if len(clocks) < 2 or not all(log.has_own_command_stamps for log in dataset.logs):
        return dataset, list(clocks)
    eam = _fitted_eam(dataset, windows, length)
    found = [_offset(dataset, recording, eam, length) for recording in range(len(clocks))]
    mean = float(np.mean([offset for (offset, _), one in zip(found, clocks, strict=True) if not one.heldout]))
    logs, aligned = list(dataset.logs), []
    for clock, pieces, (offset, half) in zip(clocks, dataset.pieces, found, strict=True):
        shift = offset - mean
        aligned.append(attrs.evolve(clock, offset_s=shift, half_width_s=half))
        for k in pieces if abs(shift) > half else ():
            logs[k] = attrs.evolve(logs[k], t_cmd=logs[k].t_cmd + shift)
    return dataset.with_logs(logs), aligned


def clock_findings(dataset: Dataset, clocks: Sequence[RecordingClock]) -> list[tuple[str, Finding]]:
    """State what was done to the stamps of each recording.

    Args:
        dataset: The logs.
        clocks: Clock of each recording.

    Returns:
        Notes, as (log name, finding).
    """
    found = []
    for clock in clocks:
        if clock.even:
            text = "the even clock of the sender explains the torque better and was restored"
            found.append((clock.log, f"t: the stamps jitter as those of received messages do; {text}"))
        if clock.offset_s is not None:
            size = f"{1e3 * clock.offset_s:.2f} ms (95 %: +- {1e3 * clock.half_width_s:.2f} ms)"
            text = "relative to the mean of the fitted logs, an offset between the clocks of the recording"
            found.append((clock.log, f"t_cmd: commands act {size} later {text}"))
    if len(clocks) == 1 and dataset.logs[0].has_own_command_stamps:
        text = "one log cannot separate the robot's input delay from an offset between its two clocks"
        found.append((clocks[0].log, f"t_cmd: {text}; record two or more"))
    return [(name, Finding("note", text.partition(":")[0], (), text)) for name, text in found]


def _own_rows(dataset: Dataset, recording: int, samples: Samples, length: float) -> Bools:
    """Rows (N, J) of one recording that are not reported."""
    rows: Bools = samples.evaluated & ~reported_rows(dataset, recording, samples.t, length)[:, None]
    return rows


@attrs.frozen(eq=False)
class _Errors:
    """Squared error (N, J) of the plain model on a recording, its rows, and the starts of clusters."""

    squares: Array
    rows: Bools
    starts: Indices


def _errors(
    logs: Sequence[Log], dataset: Dataset, recording: int, windows: Sequence[float], length: float
) -> _Errors:
    """Errors of the plain model that is fitted to a recording with these stamps."""
    samples = Samples.of(logs)
    rows = _own_rows(dataset, recording, samples, length)
    residual = samples.tau - fit_eam(samples, rows, windows=windows).predict(samples)
    return _Errors(residual**2, rows, cluster_starts(samples))


def _is_better(before: _Errors, after: _Errors) -> bool:
    """Whether the second errors are significantly smaller, by a t test over clusters."""
    both = before.rows & after.rows
    gain = np.add.reduceat(np.sum(before.squares - after.squares, axis=1, where=both), after.starts)
    used = np.logical_or.reduceat(both.any(axis=1), after.starts)
    test = stats.ttest_1samp(gain[used], 0.0, alternative="greater")
    return bool(test.pvalue < _SIGNIFICANCE_LEVEL)


def _fitted_eam(dataset: Dataset, windows: Sequence[float], length: float) -> Eam:
    """The plain model of all fitted recordings."""
    samples = Samples.of(dataset.train)
    rows = samples.evaluated.copy()
    for recording, pieces in enumerate(dataset.pieces):
        mine = np.isin(samples.log_of_row, pieces)
        rows[mine] &= ~reported_rows(dataset, recording, samples.t[mine], length)[:, None]
    return fit_eam(samples, rows, windows=windows)


def _offset(dataset: Dataset, recording: int, eam: Eam, length: float) -> tuple[float, float]:
    """Delay (s) of the commands beyond the model's input delay, and its 95 % half width."""
    samples = Samples.of([dataset.logs[k] for k in dataset.pieces[recording]])
    rows, starts = _own_rows(dataset, recording, samples, length), cluster_starts(samples)

    def errors(shifts: Array) -> Array:
        """Squared error of each cluster (C,) at each shift (S,), (S, C)."""
        moved = (attrs.evolve(eam, input_delay=eam.input_delay + shift) for shift in shifts)
        squares = ((samples.tau - one.predict(samples)) ** 2 for one in moved)
        return np.stack([np.add.reduceat(np.sum(one, axis=1, where=rows), starts) for one in squares])

    coarse, fine = _OFFSET_STEPS_S
    shifts = np.arange(-_MAX_OFFSET_S, _MAX_OFFSET_S + coarse / 2, coarse)
    about = shifts[int(np.argmin(errors(shifts).sum(axis=1)))]
    shifts = about + np.arange(-2.0 * coarse, 2.0 * coarse + fine / 2, fine)
    each = errors(shifts)
    best = float(shifts[int(np.argmin(each.sum(axis=1)))])
    # Jackknife over groups of clusters: variance (G - 1) / G sum (x_g - mean x)^2.
    group = np.arange(each.shape[1]) * _JACKKNIFE_GROUPS // each.shape[1]
    left = [shifts[int(np.argmin(each[:, group != g].sum(axis=1)))] for g in range(int(group.max()) + 1)]
    spread = np.sqrt((len(left) - 1) * np.var(left)) if len(left) > 1 else np.inf
    return best, min(float(stats.norm.ppf(0.975) * spread + fine), _MAX_OFFSET_S)
