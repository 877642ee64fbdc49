"""Examines all causes in the order of the chain and names the first one that is found.

`links` holds the causes and `report` writes the result.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import attrs

from quadvel_description.bounded_yaml import read_yaml

from .cause import Cause, Measurement
from .links import CAUSES
from .signals import PARTS, Signals

LIMITS_FILE = Path(__file__).parent / "limits.yaml"
MARGIN = 1.5
"""Factor between what healthy walks show and the limit."""


@attrs.frozen(eq=False)
class Finding:
    """A cause that was found.

    Attributes:
        cause: The cause.
        measurement: What it measured.
        limit: The limit that the measurement exceeds.
    """

    cause: type[Cause]
    measurement: Measurement
    limit: float


@attrs.frozen(eq=False)
class Diagnosis:
    """The answer.

    Attributes:
        finding: The first cause that was found; None if every link holds.
        held: Causes that were examined and not found.
        skipped: Why each of the other causes was not examined.
    """

    finding: Finding | None
    held: dict[str, Measurement]
    skipped: dict[str, str]


def healthy_values() -> dict[str, float]:
    """Return the largest number that each cause measured on healthy walks.

    Returns:
        Numbers by name of the cause; `python -m benchmarks.why.calibrate` writes them.
    """
    return {name: float(value) for name, value in read_yaml(LIMITS_FILE, "limits")["healthy"].items()}


def limit_of(cause: type[Cause], measurement: Measurement, healthy: dict[str, float]) -> float:
    """Return the number above which a cause is found.

    Args:
        cause: The cause.
        measurement: Its measurement, which may carry a limit of the training.
        healthy: Result of `healthy_values`.

    Returns:
        max(least, MARGIN times the healthy value), or the limit of the training.
    """
    if measurement.limit is not None:
        return measurement.limit
    return max(cause.least, MARGIN * healthy.get(cause.name(), 0.0))


def diagnose(signals: Signals, causes: Iterable[type[Cause]] = CAUSES) -> Diagnosis:
    """Find the first link that breaks.

    Args:
        signals: The run.
        causes: Causes in the order of the chain.

    Returns:
        The diagnosis. Causes after the one that was found are not examined: they may be its consequences.
    """
    healthy = healthy_values()
    held: dict[str, Measurement] = {}
    skipped: dict[str, str] = {}
    finding = None
    for cause in causes:
        missing = [PARTS[part] for part in cause.needs if part not in signals.parts]
        if finding is not None:
            skipped[cause.name()] = f"after {finding.cause.name()}"
        elif missing:
            skipped[cause.name()] = f"the recording lacks {', '.join(missing)}"
        elif (measurement := cause().measure(signals)) is None:
            skipped[cause.name()] = "the recording shows too little"
        elif measurement.value > (limit := limit_of(cause, measurement, healthy)):
            finding = Finding(cause, measurement, limit)
        else:
            held[cause.name()] = measurement
    return Diagnosis(finding, held, skipped)
