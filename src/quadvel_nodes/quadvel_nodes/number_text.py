"""Numbers for people: a number that is not there is a dash, never "nan"."""

from __future__ import annotations

import math

DASH = "–"


def number_text(value: float | None, spec: str) -> str:
    """`value` by the format `spec`, such as ".2f"; a dash where it is None or not finite."""
    return DASH if value is None or not math.isfinite(value) else format(value, spec)
