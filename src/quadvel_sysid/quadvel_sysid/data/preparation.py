"""Preprocess logs: choose the time stamps and the averaging of q and dq that fit the torque best.

If the drive acted on the noise of its encoders, the torque contains this noise, and q and dq stay
as they are. If not, the noise is averaged out first; otherwise an effect could be fitted to it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs
import numpy as np

from quadvel_description.arrays import Array

from ..logs.findings import Finding
from ..logs.log import LogError
from ..options import SEARCH_DEFAULTS, SearchOptions
from .clocks import RecordingClock, align_commands, choose_stamps, clock_findings, remove_drift
from .dataset import Dataset
from .noise import noise_variance
from .plain_model import Eam, fit_eam
from .signals import Samples
from .split import MIN_BLOCK_S, DataSplit, block_length, cluster_starts, reported_rows

_MIN_ROWS = 20
"""Rows of each joint and part, at least."""
_ENCODER_NOISE_SHARE = 0.01
"""Encoders are noisy if their noise adds at least this share of the torque's noise variance."""
_AVERAGING_ROWS = np.array([1, 2, 4, 8])
"""Rows to either side over which q and dq may be averaged."""
_MAX_AVERAGING_S = 0.0081
"""Longest half width of an average, s."""
_MAX_AVERAGING_BLURRED_S = 0.0021
"""The same if only friction shows the noise, s: longer ones blur bristles and backlash."""
_FRICTION_WIDTHS_RAD_S = np.array([0.02, 0.06, 0.2])
"""Velocities w (rad/s) of the friction curves tanh(dq / w) that are fitted."""
_MIN_AVERAGING_GAIN = 0.005
"""Share of the noise variance by which each wider average has to reduce the error."""


@attrs.frozen(eq=False)
class Preprocessed:
    """Preprocessed logs and the plain model fitted to them.

    Attributes:
        samples: Rows of all logs, N rows of J joints.
        parts: Which rows are fitted, used for selection, or held out.
        eam: The plain actuator model.
        clocks: Clock of each recording.
    """

    samples: Samples
    parts: DataSplit
    eam: Eam
    clocks: tuple[RecordingClock, ...]


def preprocess(
    dataset: Dataset,
    windows: Sequence[float],
    shortest: float = MIN_BLOCK_S,
    options: SearchOptions = SEARCH_DEFAULTS,
) -> tuple[Preprocessed, list[tuple[str, Finding]]]:
    """Correct the clocks of each recording, then choose how far q and dq are averaged.

    Args:
        dataset: The logs.
        windows: Windows (s) to try in the plain model, over which the drive averages commands.
        shortest: Shortest block, s.
        options: Options of the search.

    Returns:
        The preprocessed logs, and a note for each correction, as (log name, finding).
    """
    length = block_length(dataset, shortest)
    dataset, clocks = choose_stamps(dataset, windows, length, options)
    dataset, clocks = remove_drift(dataset, clocks, windows, length)
    dataset, clocks = align_commands(dataset, clocks, windows, length)

    def fit_logs(steady: float) -> Preprocessed:
        samples = Samples.of(dataset.logs, steady, options)
        parts = split_rows(samples, dataset, length, options.cluster_motion_rad)
        return Preprocessed(samples, parts, fit_eam(samples, parts.fit, windows=windows), tuple(clocks))

    prepared, steady, notes = fit_logs(0.0), 0.0, clock_findings(dataset, clocks)
    if options.averaged_encoders:
        prepared, steady = _choose_averaging(prepared, fit_logs)
    if steady:
        text = f"is averaged out over {1e3 * steady:.3g} ms to either side"
        text = f"q, dq: their noise, on which the drive did not act, {text}"
        notes.append((dataset.logs[0].name, Finding("note", "dq", (), text)))
    return prepared, notes


def split_rows(
    samples: Samples, dataset: Dataset, length: float, motion: float = SEARCH_DEFAULTS.cluster_motion_rad
) -> DataSplit:
    """Divide the rows into blocks that are fitted, used for selection, or held out.

    Of the blocks that `reported_rows` leaves, half are fitted and half are used for selection.

    Args:
        samples: Rows of all logs.
        dataset: The logs.
        length: Length of the blocks, s.
        motion: Motion of some joint that ends a cluster, rad.

    Returns:
        The parts, (N, J) masks.

    Raises:
        LogError: A joint has too few rows in one part.
    """
    block = np.floor(samples.t / length).astype(int)
    report, used = np.zeros((2, len(block)), dtype=bool)
    for recording, pieces in enumerate(dataset.pieces):
        mine = np.isin(samples.log_of_row, pieces)
        report[mine] = reported_rows(dataset, recording, samples.t[mine], length)
        used[mine] = not dataset.is_heldout(recording)
    select = block % 2 == 1 if dataset.heldout else np.isin(block % 5, (1, 3))
    rows = {"fitted": used & ~(select | report), "selecting": used & select & ~report, "reported": report}
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
    rows = parts.fit_or_select
    noise = noise_variance(samples, rows, samples.tau - eam.predict(samples)).mean()
    gains = np.ones(2) if samples.commanded else eam.gains.mean(axis=1)
    kp, kd = gains * samples.reference_gains
    q_noise, dq_noise = samples.sources.encoder_noise
    noisy = (kp**2 * q_noise + kd**2 * dq_noise).mean() >= _ENCODER_NOISE_SHARE * noise

    def error_of(prepared: Preprocessed) -> Array:
        """Errors with friction (J,), N^2 m^2; unless `noisy`, minus the mean one of the PD law alone."""
        return _errors_with_friction(prepared) - (0.0 if noisy else prepared.eam.mse)

    chosen, least = 0.0, error_of(prepared)
    widths = _AVERAGING_ROWS * samples.period
    for steady in widths[widths <= (_MAX_AVERAGING_S if noisy else _MAX_AVERAGING_BLURRED_S)]:
        other = fit_logs(steady)
        error, margin = error_of(other), _MIN_AVERAGING_GAIN * noise
        # An average that is too wide for the fastest joint would leave an error that effects explain.
        if error.mean() < least.mean() - margin and (error < least + margin).all():
            prepared, chosen, least = other, float(steady), error
        elif error.mean() > least.mean():
            break
    return prepared, chosen


def _errors_with_friction(prepared: Preprocessed) -> Array:
    """Mean squared errors (J,), N^2 m^2, of the EAM with friction, which shows noise of dq most."""
    samples, eam, rows = prepared.samples, prepared.eam, prepared.parts.fit
    dq = samples.at(eam.input_delay, eam.output_delay, eam.window).dq
    left, errors = samples.tau - eam.predict(samples), np.zeros(rows.shape[1])
    for j, chosen in enumerate(rows.T):
        steps = np.tanh(dq[chosen, j, None] / _FRICTION_WIDTHS_RAD_S)
        r = left[chosen, j] - steps @ np.linalg.lstsq(steps, left[chosen, j], rcond=None)[0]
        errors[j] = np.mean(r**2)
    return errors
