"""Numbers as text: missing and non-finite values are shown as a dash, counts with their noun."""

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


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, in the plural unless it is one.

    Args:
        count: The count.
        noun: The noun, with a regular plural.

    Returns:
        Such as "1 message" or "2 messages".
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
