"""Preprocess logs: choose time stamps and the smoothing of q and dq that explain the torque best.

The choice is the one that explains the torque best. If the drive acted on noisy encoders, their
noise is in its torque and the measurements stay as they are. If it did not, the noise is averaged
out before anything is fitted, because an effect could otherwise be fitted to it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs
import numpy as np

from ..logs.excerpts import has_jitter, restore_even_clock
from ..logs.findings import Finding
from ..logs.log import Log, LogError
from ..options import SEARCH_DEFAULTS, SearchOptions
from .dataset import Dataset
from .noise import encoder_variance, noise_variance
from .plain_model import Eam, fit_eam
from .signals import Samples
from .split import DataSplit, cluster_starts

_MIN_BLOCKS = 20
"""Blocks of a log, at least."""
MIN_BLOCK_S, _MAX_BLOCK_S = 0.2, 2.0
"""s; shortest and longest duration of the blocks that are fitted, used for selection, or held out."""
_MIN_ROWS = 20
"""Rows of each joint and part, at least."""
_EVEN_CLOCK_ERROR_RATIO = 0.97
"""The even clock is used if it leaves at most this share of the error."""
_ENCODER_NOISE_SHARE = 0.01
"""Encoders are noisy if their noise adds at least this share of the torque's noise variance."""
_AVERAGING_ROWS = np.array([1, 2, 4, 8])
"""Rows to either side over which q and dq may be averaged."""
_MAX_AVERAGING_S, _MAX_AVERAGING_BLURRED_S = 0.0081, 0.0021
"""s; longest averages, in general and if only friction shows the noise: bristles and backlash act on
the time scale of the longer ones.
"""
_FRICTION_WIDTHS_RAD_S = np.array([0.02, 0.06, 0.2])
"""rad/s; widths of the smooth step of friction that are fitted."""
_MIN_AVERAGING_GAIN = 0.005
"""Share of the noise variance by which each wider average has to reduce the error."""


@attrs.frozen(eq=False)
class Preprocessed:
    """Preprocessed logs and the plain model fitted to them.

    Attributes:
        samples: Rows of all logs, N rows of J joints.
        parts: Which rows are fitted, used for selection, or held out.
        eam: The plain actuator model.
    """

    samples: Samples
    parts: DataSplit
    eam: Eam


def preprocess(
    dataset: Dataset,
    windows: Sequence[float],
    shortest: float = MIN_BLOCK_S,
    options: SearchOptions = SEARCH_DEFAULTS,
) -> tuple[Preprocessed, list[tuple[str, Finding]]]:
    """Choose the time stamps and the averaging that explain the torque best.

    Args:
        dataset: The logs.
        windows: Steps (s) of the drive that the plain model tries.
        shortest: Shortest block, s.
        options: Options of the search.

    Returns:
        The preprocessed logs, and a note for each choice other than the logs as they are.
    """

    def fit_logs(logs: Sequence[Log], steady: float = 0.0) -> Preprocessed:
        samples = Samples.of(logs, steady, options)
        parts = split_rows(samples, dataset, shortest, options.cluster_motion_rad)
        return Preprocessed(samples, parts, fit_eam(samples, parts.fit, windows=windows))

    logs: Sequence[Log] = dataset.logs
    prepared, notes = fit_logs(logs), []
    if options.even_clocks and any(has_jitter(log) for log in logs):
        even = [restore_even_clock(log) for log in logs]
        other = fit_logs(even)
        if other.eam.mse <= _EVEN_CLOCK_ERROR_RATIO * prepared.eam.mse:
            logs, prepared = even, other
            text = "the even clock of the sender explains the torque better and was restored"
            notes.append(("t", f"t: the stamps jitter as those of received messages do; {text}"))
    steady = 0.0
    if options.averaged_encoders:
        prepared, steady = _choose_averaging(prepared, lambda steady: fit_logs(logs, steady))
    if steady:
        text = f"is averaged out over {1e3 * steady:.3g} ms to either side"
        notes.append(("dq", f"q, dq: their noise, on which the drive did not act, {text}"))
    return prepared, [(logs[0].name, Finding("note", field, (), text)) for field, text in notes]


def split_rows(
    samples: Samples, dataset: Dataset, shortest: float, motion: float = SEARCH_DEFAULTS.cluster_motion_rad
) -> DataSplit:
    """Divide the rows into blocks that are fitted, used for selection, or held out.

    Of five consecutive blocks, two are fitted, two are used for selection and one is held out. If
    there are held-out logs, these alone are held out.

    Args:
        samples: Rows of all logs.
        dataset: The logs.
        shortest: Shortest block, s.
        motion: Motion of some joint that ends a cluster, rad.

    Returns:
        The parts, (N, J) masks.

    Raises:
        LogError: A joint has too few rows in one part.
    """
    spans = [log.duration for log in samples.logs]
    length = float(np.clip(min(spans) / _MIN_BLOCKS, shortest, _MAX_BLOCK_S))
    block = np.floor(samples.t / length).astype(int)
    if dataset.heldout:
        report = samples.log_of_row >= len(dataset.train)
        select = (block % 2 == 1) & ~report
    else:
        report, select = block % 5 == 4, np.isin(block % 5, (1, 3))
    rows = {"fitted": ~(select | report), "selecting": select, "reported": report}
    parts = {word: samples.evaluated & chosen[:, None] for word, chosen in rows.items()}
    for word, chosen in parts.items():
        count = chosen.sum(axis=0)
        if (count < _MIN_ROWS).any():
            joint = samples.joints[int(np.argmin(count))]
            raise LogError(
                f"{samples.logs[0].name}: valid/{joint}: {int(count.min())} rows to be {word}, "
                f"expected {_MIN_ROWS} or more"
            )
    return DataSplit(
        fit=parts["fitted"],
        select=parts["selecting"],
        report=parts["reported"],
        cluster_starts=cluster_starts(samples, motion),
        noise_overlap=0 if dataset.body is None else 1,
    )


def _choose_averaging(
    prepared: Preprocessed, fit_logs: Callable[[float], Preprocessed]
) -> tuple[Preprocessed, float]:
    """Average q and dq over wider windows while this reduces the error; return the half width, s."""
    samples, parts, eam = prepared.samples, prepared.parts, prepared.eam
    rows, gains = parts.fit_or_select, np.ones(2) if samples.commanded else eam.gains.mean(axis=1)
    noise = noise_variance(samples, rows, samples.tau - eam.predict(samples)).mean()
    noisy = (
        encoder_variance(samples, rows, *gains * samples.reference_gains).mean()
        >= _ENCODER_NOISE_SHARE * noise
    )

    def error_of(prepared: Preprocessed) -> float:
        """Error with friction; relative to the error without it if noise hardly affects the PD law."""
        return _error_with_friction(prepared) - (0.0 if noisy else prepared.eam.mse)

    chosen, least = 0.0, error_of(prepared)
    widths = _AVERAGING_ROWS * samples.period
    for steady in widths[widths <= (_MAX_AVERAGING_S if noisy else _MAX_AVERAGING_BLURRED_S)]:
        other = fit_logs(steady)
        error = error_of(other)
        if error < least - _MIN_AVERAGING_GAIN * noise:
            prepared, chosen, least = other, float(steady), error
        elif error > least:
            break
    return prepared, chosen


def _error_with_friction(prepared: Preprocessed) -> float:
    """Mean squared error of the plain model with friction, whose step noisy speeds blur most."""
    samples, eam, rows = prepared.samples, prepared.eam, prepared.parts.fit
    dq = samples.at(eam.input_delay, eam.output_delay, eam.window).dq
    left, total = samples.tau - eam.predict(samples), 0.0
    for j, chosen in enumerate(rows.T):
        steps = np.tanh(dq[chosen, j, None] / _FRICTION_WIDTHS_RAD_S)
        r = left[chosen, j] - steps @ np.linalg.lstsq(steps, left[chosen, j], rcond=None)[0]
        total += float(r @ r)
    return total / int(rows.sum())
