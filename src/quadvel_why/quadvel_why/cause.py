"""Interface of causes: each looks for one defect in a recording. Knows no files and draws nothing.

A cause measures one number on the run. It is found if the number exceeds the cause's limit, which `limits` derives from
healthy walks. `links` holds all causes in the order of the chain.
"""

from __future__ import annotations

from enum import Enum

import attrs
import numpy as np

from quadvel_description.arrays import Array

from .signals import Signals

SHOWN_S = 0.6
"""Span of time of a picture, s."""


class Link(Enum):
    """A part of the chain from the policy file to the ground; the order is that of the diagnosis."""

    CONTRACT = "contract"
    TIMING = "timing"
    SENSORS = "sensors"
    ESTIMATOR = "estimator"
    DRIVES = "drives"
    GROUND = "ground"
    TASK = "task"


@attrs.frozen(eq=False)
class Trace:
    """A signal, and what was expected, for the picture.

    Attributes:
        title: Name and unit.
        time: (n,), s.
        measured: (n,).
        expected: (n,).
    """

    title: str
    time: Array
    measured: Array
    expected: Array


@attrs.frozen(eq=False)
class Measurement:
    """What a cause found.

    Attributes:
        value: The number that is compared with the limit, in the unit of the cause.
        sentence: What was found, with numbers and units.
        span: Begin and end of the time in which it shows, s.
        traces: For the picture.
        alternatives: Names of causes that look the same in this recording, each with the experiment that sets them
            apart.
        limit: Limit from the training of the policy, in the unit of the cause; None: that of
            healthy walks.
    """

    value: float
    sentence: str = ""
    span: tuple[float, float] = (0.0, 0.0)
    traces: tuple[Trace, ...] = ()
    alternatives: tuple[tuple[str, str], ...] = ()
    limit: float | None = None


NOTHING = Measurement(0.0)


class Cause:
    """Looks for one defect. The first paragraph of a cause's docstring is its row in docs/why.md.

    Attributes:
        link: Part of the chain to which it belongs.
        unit: Unit of the measured number.
        least: Smallest number that is worth naming, in `unit`; no limit is lower.
        needs: Parts of a recording without which the cause cannot be examined, keys of `signals.PARTS`.
        remedy: What to do.
    """

    link: Link
    unit: str
    least: float
    needs: tuple[str, ...] = ()
    remedy: str

    def measure(self, signals: Signals) -> Measurement | None:
        """Measure one run.

        Args:
            signals: The run and what follows from it.

        Returns:
            The measurement; None if the run shows too little of it.

        Raises:
            NotImplementedError: A subclass must implement this method.
        """
        raise NotImplementedError

    @classmethod
    def name(cls) -> str:
        """Return the name of the cause.

        Returns:
            The class name in lower case with underscores.
        """
        return "".join(f"_{c.lower()}" if c.isupper() else c for c in cls.__name__).lstrip("_")


def worst_span(time: Array, error: Array) -> tuple[float, float]:
    """Return the SHOWN_S in which an error is largest.

    Args:
        time: (n,), s.
        error: Magnitudes, (n,); NaN counts as zero.

    Returns:
        Begin and end, s.
    """
    total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(error))])
    ends = np.searchsorted(time, time + SHOWN_S, side="right")
    first = int(np.argmax(total[ends] - total[: len(time)]))
    return float(time[first]), float(time[min(ends[first], len(time)) - 1])
