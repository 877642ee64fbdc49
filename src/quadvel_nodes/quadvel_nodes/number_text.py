"""Numbers as text: missing and non-finite values are shown as a dash."""

from __future__ import annotations

import math

DASH = "–"


def number_text(value: float | None, spec: str) -> str:
    """Format a number, or return a dash if it is missing.

    Args:
        value: The number; None, NaN or infinity count as missing.
        spec: Format specification, such as ".2f".

    Returns:
        The text.
    """
    return DASH if value is None or not math.isfinite(value) else format(value, spec)
