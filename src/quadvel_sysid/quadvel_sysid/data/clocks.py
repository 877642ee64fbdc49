"""Clocks of recordings: jittering stamps, and drift and offset between the clocks of states and commands.

They belong to a recording, not to the robot. They are chosen by the torque error of the plain model
(`plain_model`: PD gains and two delays), on rows that do not enter the reported error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

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


@attrs.frozen
class _ShiftGrid:
    """Grids of shifts of the commands, s: a coarse one about 0, and a fine one about its best shift."""

    coarse_reach: float
    coarse_step: float
    fine_reach: float
    fine_step: float


_OFFSETS = _ShiftGrid(0.004, 0.0005, 0.001, 0.00005)
"""Offsets of the clocks as the plain model sees them."""
_REALIGNMENT = _ShiftGrid(0.002, 0.0005, 0.0005, 0.0001)
"""Further shifts of a held-out recording; each takes a prediction of the whole corrected model."""
_EQUAL_ERRORS = 1e-6
"""Relative difference of errors that round-off explains."""
_JACKKNIFE_GROUPS = 10
_MIN_CLUSTERS = 10
"""Clusters on which a drift is tested, at least."""
_MAX_DRIFT_S = 0.010
"""Largest drift between the two clocks over a recording, s: 100 ppm, as of two crystals, in 100 s."""
_DRIFT_STEPS_S = (0.0005, 0.0001)
"""Steps of the coarse and the fine grid of delays, whose change over time is the drift, s."""


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
        drift: Time by which its command clock fell behind that of its states, for each second; its
            command stamps were corrected. 0 if no drift is significant.
        drift_half_width: Half width of the 95 % interval of the drift.
    """

    log: str
    heldout: bool
    even: bool
    offset_s: float | None = None
    half_width_s: float = 0.0
    drift: float = 0.0
    drift_half_width: float = 0.0

    def shifted_further(self, shift: float) -> RecordingClock:
        """Return the clock after a further shift of the commands.

        Args:
            shift: The shift, s.

        Returns:
            The clock with the whole offset; the same clock without a shift.
        """
        if not shift:
            return self
        offset = self.offset_s or 0.0
        return attrs.evolve(self, offset_s=shift + (offset if abs(offset) > self.half_width_s else 0.0))


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


def remove_drift(
    dataset: Dataset, clocks: Sequence[RecordingClock], windows: Sequence[float], length: float
) -> tuple[Dataset, list[RecordingClock]]:
    """Put the command stamps of each recording on the clock of its states, where the two drift apart.

    Two computers' clocks differ by some parts in 100,000, and clocks that software makes by more. A
    delay that changes linearly over the recording replaces a constant one if it predicts the torque
    significantly better: it is fitted on every other cluster of rows and tested on the rest, in a
    one-sided t test at the level 0.01.

    Args:
        dataset: The logs.
        clocks: Clock of each recording.
        windows: Windows (s) to try in the plain model, over which the drive averages commands.
        length: Length of the blocks of rows, s.

    Returns:
        The logs with the corrected stamps, and the clocks with their drift.
    """
    logs, found = list(dataset.logs), []
    for recording, (clock, pieces) in enumerate(zip(clocks, dataset.pieces, strict=True)):
        mine = [logs[k] for k in pieces]
        if all(log.has_own_command_stamps for log in mine):
            clock, mine = _without_drift(dataset, recording, clock, mine, windows, length)
        for k, log in zip(pieces, mine, strict=True):
            logs[k] = log
        found.append(clock)
    return dataset.with_logs(logs), found


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


def align_heldout(
    predict: Callable[[Samples], Array], samples: Samples, logs: Sequence[int], rows: Bools
) -> tuple[Samples, float]:
    """Shift the commands of a held-out recording so that a fitted model predicts it best.

    `align_commands` finds the offset of its clocks with the plain model. What that lacks, such as a lag
    or an inertia, acts like a delay, which is another one in each recording. A shift within its 95 %
    interval of 0 is not applied.

    Args:
        predict: Torque (N, J), N m, that the model predicts for samples.
        samples: Rows of all logs.
        logs: Numbers of the recording's logs.
        rows: Rows (N, J) that may be used: none that is fitted or reported.

    Returns:
        The samples with the shift, and the shift, s.
    """
    starts = cluster_starts(samples)

    def errors(shifts: Array) -> Array:
        """Squared error of each cluster at each shift (S,), s, (S, C)."""
        moved = (samples.with_shifted_commands(logs, float(shift)) for shift in shifts)
        return np.stack([_cluster_errors(one.tau - predict(one), rows, starts) for one in moved])

    shift, half = _best_shift(errors, _REALIGNMENT)
    if abs(shift) <= half:
        return samples, 0.0
    return samples.with_shifted_commands(logs, shift), shift


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
        if clock.drift:
            rate, half = 1e6 * clock.drift, 1e6 * clock.drift_half_width
            text = f"falls behind that of the states by {rate:.0f} us each second (95 %: +- {half:.0f} us)"
            found.append((clock.log, f"t_cmd: the clock of the commands {text}; their stamps were corrected"))
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
    if used.sum() < 2:
        return False
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


@attrs.frozen(eq=False)
class _DelayProfile:
    """Squared error of the plain model on a recording for each delay of its commands.

    Attributes:
        eam: The plain model, without that delay.
        samples: Rows of the recording.
        rows: Rows that are used, (N, J).
        starts: Row at which each of the C clusters begins, (C,).
    """

    eam: Eam
    samples: Samples
    rows: Bools
    starts: Indices

    @classmethod
    def of(
        cls,
        eam: Eam | None,
        logs: Sequence[Log],
        dataset: Dataset,
        recording: int,
        windows: Sequence[float],
        length: float,
    ) -> _DelayProfile:
        """Prepare the rows of one recording; without a model, that of the recording itself."""
        samples = Samples.of(logs)
        rows = _own_rows(dataset, recording, samples, length)
        return cls(eam or fit_eam(samples, rows, windows=windows), samples, rows, cluster_starts(samples))

    def errors(self, delays: Array) -> Array:
        """Return the squared error of each cluster at each delay (D,), s, (D, C)."""
        moved = (attrs.evolve(self.eam, input_delay=self.eam.input_delay + delay) for delay in delays)
        residuals = (self.samples.tau - one.predict(self.samples) for one in moved)
        return np.stack([_cluster_errors(one, self.rows, self.starts) for one in residuals])

    @property
    def time(self) -> Array:
        """Time at which each cluster begins, (C,), s."""
        return self.samples.t[self.starts]


def _offset(dataset: Dataset, recording: int, eam: Eam, length: float) -> tuple[float, float]:
    """Delay (s) of the commands beyond the model's input delay, and its 95 % half width."""
    logs = [dataset.logs[k] for k in dataset.pieces[recording]]
    profile = _DelayProfile.of(eam, logs, dataset, recording, (), length)
    offset, half = _best_shift(profile.errors, _OFFSETS)
    return offset, min(half, _OFFSETS.coarse_reach)


def _best_shift(errors: Callable[[Array], Array], grid: _ShiftGrid) -> tuple[float, float]:
    """Find the shift with the least error on two grids.

    Args:
        errors: Returns the squared error of each cluster for shifts (S,), s, (S, C).
        grid: The grids.

    Returns:
        The shift, s, and the half width of its 95 % interval, s.
    """
    shifts = np.arange(-grid.coarse_reach, grid.coarse_reach + grid.coarse_step / 2, grid.coarse_step)
    about = _least_shift(shifts, errors(shifts).sum(axis=1))
    shifts = about + np.arange(-grid.fine_reach, grid.fine_reach + grid.fine_step / 2, grid.fine_step)
    each = errors(shifts)

    def best(used: Bools | slice) -> float:
        return _least_shift(shifts, each[:, used].sum(axis=1))

    return best(slice(None)), _jackknife_half_width(best, each.shape[1]) + grid.fine_step


def _least_shift(shifts: Array, errors: Array) -> float:
    """Return the shift (S,) with the least error (S,); of equal ones, as between two rows, the smallest."""
    equal = errors <= (1.0 + _EQUAL_ERRORS) * errors.min()
    return float(min(shifts[equal], key=abs))


def _cluster_errors(residual: Array, rows: Bools, starts: Indices) -> Array:
    """Squared error of each cluster, (C,), of a residual (N, J) on some rows."""
    return np.asarray(np.add.reduceat(np.sum(residual**2, axis=1, where=rows), starts))


def _jackknife_half_width(estimate: Callable[[Bools], float], clusters: int) -> float:
    """Half width of the 95 % interval of an estimate from clusters, by leaving out groups of them."""
    # Variance (G - 1) / G sum (x_g - mean x)^2 over the estimates x_g without group g.
    group = np.arange(clusters) * _JACKKNIFE_GROUPS // clusters
    left = [estimate(group != g) for g in range(int(group.max()) + 1)]
    spread = np.sqrt((len(left) - 1) * np.var(left)) if len(left) > 1 else np.inf
    return float(stats.norm.ppf(0.975) * spread)


def _without_drift(
    dataset: Dataset,
    recording: int,
    clock: RecordingClock,
    logs: Sequence[Log],
    windows: Sequence[float],
    length: float,
) -> tuple[RecordingClock, list[Log]]:
    """Return a recording's clock with its drift, and its logs without; both unchanged if there is none."""
    # Twice: the gains of the first model are those of delays that are wrong most of the time.
    for step, most in zip(_DRIFT_STEPS_S, (_MAX_DRIFT_S, 2.0 * _DRIFT_STEPS_S[0]), strict=True):
        profile = _DelayProfile.of(None, logs, dataset, recording, windows, length)
        lines = _DelayLines.of(profile, step, most)
        if not clock.drift and not lines.drift_is_significant():
            return clock, list(logs)
        drift, origin = lines.drift(), logs[0].t_cmd[0]
        logs = [attrs.evolve(log, t_cmd=log.t_cmd + drift * (log.t_cmd - origin)) for log in logs]
        clock = attrs.evolve(clock, drift=clock.drift + drift, drift_half_width=lines.half_width())
    return clock, list(logs)


@attrs.frozen(eq=False)
class _DelayLines:
    """Delays of the commands that change linearly with time: d(t) = b + a (t - t_mid) / T.

    Attributes:
        time: Time of each cluster, (C,), s.
        delays: Delays of a grid, (D,), s, ascending by `step`.
        each: Squared error of each cluster at each of them, (D, C).
        step: Step of the grid, s.
    """

    time: Array
    delays: Array
    each: Array
    step: float

    @classmethod
    def of(cls, profile: _DelayProfile, step: float, most: float) -> _DelayLines:
        """Compute the errors on a grid of delays within half of the largest drift."""
        reach = round(0.5 * most / step)
        delays: Array = step * np.arange(-reach, reach + 1, dtype=np.float64)
        return cls(profile.time, delays, profile.errors(delays), step)

    def drift(self, used: Bools | slice = slice(None)) -> float:
        """Return the change of the delay for each second, from the clusters `used`."""
        return self._best_line(used)[0] / float(np.ptp(self.time))

    def half_width(self) -> float:
        """Return the half width of the 95 % interval of the drift, at least a step of the grid."""
        step = 2.0 * self.step / float(np.ptp(self.time))
        return _jackknife_half_width(self.drift, len(self.time)) + step

    def drift_is_significant(self) -> bool:
        """Return whether a line beats a constant delay on clusters that neither was fitted to."""
        tested = np.arange(len(self.time)) % 2 == 1
        if tested.sum() < _MIN_CLUSTERS:
            return False
        line, constant = self._best_line(~tested), self._best_line(~tested, with_drift=False)
        if not line[0]:
            return False
        gain = (self._errors(*constant) - self._errors(*line))[tested]
        return bool(stats.ttest_1samp(gain, 0.0, alternative="greater").pvalue < _SIGNIFICANCE_LEVEL)

    def _best_line(self, used: Bools | slice, with_drift: bool = True) -> tuple[float, float]:
        """Return the change over the recording and the middle delay, s, with the least error."""
        changes = 2.0 * self.delays if with_drift else np.zeros(1)
        lines = [(change, middle) for change in changes for middle in self.delays]
        return min(lines, key=lambda line: float(self._errors(*line)[used].sum()))

    def _errors(self, change: float, middle: float) -> Array:
        """Return the squared error of each cluster, (C,), for a line; between grid points linearly."""
        share = (self.time - self.time[0]) / np.ptp(self.time) - 0.5
        at = np.clip((middle + change * share - self.delays[0]) / self.step, 0.0, len(self.delays) - 1.001)
        below, here = np.floor(at).astype(int), np.arange(len(at))
        weight = at - below
        return np.asarray((1.0 - weight) * self.each[below, here] + weight * self.each[below + 1, here])
