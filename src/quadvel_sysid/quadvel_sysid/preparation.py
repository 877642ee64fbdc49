"""How a log's rows are read: with stamps as logged or of an even sender, q and dq as logged or averaged over some rows.

Whichever explains the torque better. A drive that acted on noisy encoders has their noise in its torque; where it did not,
the noise is averaged out before anything is fitted, as whatever filters would be taken for an effect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs
import numpy as np

from .criterion import DataSplit, cluster_starts, encoder_variance, noise_variance
from .eam import Eam, fit_eam
from .identification_data import IdentificationData
from .logs.excerpts import evened, jitters
from .logs.findings import Finding
from .logs.log import Log, LogError
from .signals import Samples

_BLOCKS = 20  # of a log, at least
SHORTEST, _LONGEST = 0.2, 2.0
"""s, of the blocks of which some are fitted, some select and some are reported"""
_LEAST_ROWS = 20
_CLEARLY = 0.97
"""of the error: what an even clock has to leave at most"""
_NOISY = 0.01
"""of the torque's noise: what encoders' noise may add to it"""
_WIDTHS = np.array([1, 2, 4, 8])
"""rows to either side that q and dq may be averaged over"""
_LONGEST_MEAN, _BLURRED_MEAN = 0.0081, 0.0021
"""s, at most; and where only friction shows the noise: bristles and play act on as slow a scale as the longer ones"""
_AT_REST = np.array([0.02, 0.06, 0.2])
"""rad/s, widths of friction's step"""
_STEADIER = 0.005
"""of the noise: what each further step has to take off the error"""


@attrs.frozen(eq=False)
class Preprocessed:
    """Samples, which of their rows are for what, and the plain model on them."""

    samples: Samples
    parts: DataSplit
    eam: Eam


def preprocess(
    material: IdentificationData, windows: Sequence[float], shortest: float = SHORTEST
) -> tuple[Preprocessed, list[tuple[str, Finding]]]:
    """The reading that explains the torque best, and what was chosen. shortest: s, blocks at least."""

    def tried(logs: Sequence[Log], steady: float = 0.0) -> Preprocessed:
        samples = Samples(logs, steady)
        parts = split_rows(samples, material, shortest)
        return Preprocessed(samples, parts, fit_eam(samples, parts.fit, windows=windows))

    logs: Sequence[Log] = material.logs
    found, notes = tried(logs), []
    if any(jitters(log) for log in logs):
        even = [evened(log) for log in logs]
        other = tried(even)
        if other.eam.mse <= _CLEARLY * found.eam.mse:
            logs, found = even, other
            text = "the even clock of the sender explains the torque better and was restored"
            notes.append(("t", f"t: the stamps jitter as those of received messages do; {text}"))
    found, steady = _steadied(found, lambda steady: tried(logs, steady))
    if steady:
        text = f"is averaged out over {1e3 * steady:.3g} ms to either side"
        notes.append(("dq", f"q, dq: their noise, on which the drive did not act, {text}"))
    return found, [(logs[0].name, Finding("note", field, (), text)) for field, text in notes]


def split_rows(samples: Samples, material: IdentificationData, shortest: float) -> DataSplit:
    """Blocks of the logs in turn: two are fitted, two select, one is reported; a log that is held out is the only one reported."""
    spans = [one.log.duration for one in samples.logs]
    length = float(np.clip(min(spans) / _BLOCKS, shortest, _LONGEST))
    block = np.floor(samples.t / length).astype(int)
    if material.has_heldout:
        report = samples.log_of_row >= material.fitted_count
        select = (block % 2 == 1) & ~report
    else:
        report, select = block % 5 == 4, np.isin(block % 5, (1, 3))
    rows = {"fitted": ~(select | report), "selecting": select, "reported": report}
    parts = {word: samples.judged & chosen[:, None] for word, chosen in rows.items()}
    for word, chosen in parts.items():
        count = chosen.sum(axis=0)
        if (count < _LEAST_ROWS).any():
            joint = samples.joints[int(np.argmin(count))]
            raise LogError(
                f"{samples.logs[0].log.name}: valid/{joint}: {int(count.min())} rows to be {word}, "
                f"expected {_LEAST_ROWS} or more"
            )
    overlap = 0 if material.body is None else 1
    return DataSplit(parts["fitted"], parts["selecting"], parts["reported"], cluster_starts(samples), overlap)


def reference_gains(samples: Samples) -> tuple[float, float]:
    """The gains that the deviations are given at: the usual ones of the log."""
    kp, kd = (
        float(np.median(np.concatenate([one.gains[name].ravel() for one in samples.logs])))
        for name in ("kp", "kd")
    )
    return max(kp, 1e-6), max(kd, 1e-6)


def _steadied(found: Preprocessed, tried: Callable[[float], Preprocessed]) -> tuple[Preprocessed, float]:
    """The reading with q and dq averaged over so long (s) to either side as it pays; `tried` makes one."""
    samples, parts, eam = found.samples, found.parts, found.eam
    rows, gains = parts.fit_or_select, np.ones(2) if samples.commanded else eam.gains.mean(axis=1)
    noise = noise_variance(samples, rows, samples.tau - eam.predict(samples)).mean()
    noisy = encoder_variance(samples, rows, *gains * reference_gains(samples)).mean() >= _NOISY * noise

    def left(one: Preprocessed) -> float:
        """Error beside dry friction, or how much more than without where the PD law itself is hardly blurred."""
        return _beside_friction(one) - (0.0 if noisy else one.eam.mse)

    chosen, least = 0.0, left(found)
    widths = _WIDTHS * samples.period
    for steady in widths[widths <= (_LONGEST_MEAN if noisy else _BLURRED_MEAN)]:
        other = tried(steady)
        error = left(other)
        if error < least - _STEADIER * noise:
            found, chosen, least = other, float(steady), error
        elif error > least:
            break
    return found, chosen


def _beside_friction(one: Preprocessed) -> float:
    """Mean squared error of the EAM with dry friction, whose steps noisy speeds blur most, on each joint beside it."""
    samples, eam, rows = one.samples, one.eam, one.parts.fit
    dq = samples.at(eam.input_delay, eam.output_delay, eam.window).dq
    left, total = samples.tau - eam.predict(samples), 0.0
    for j, chosen in enumerate(rows.T):
        steps = np.tanh(dq[chosen, j, None] / _AT_REST)
        r = left[chosen, j] - steps @ np.linalg.lstsq(steps, left[chosen, j], rcond=None)[0]
        total += float(r @ r)
    return total / int(rows.sum())
