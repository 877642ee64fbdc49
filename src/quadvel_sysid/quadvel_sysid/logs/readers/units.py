"""Units that a file states in its head or in the row below, as factors to SI."""

from __future__ import annotations

import math
import re

_DEGREE = math.pi / 180.0
_TURN_PER_MINUTE = math.pi / 30.0
_FACTORS = {
    1.0: ("s", "rad", "rad/s", "nm", "nm/rad", "nms/rad", "nm/rad/s", "v", "c", "degc", "1", "-"),
    1e-3: ("ms", "mrad", "mrad/s", "mnm", "nmm", "mv"),
    1e-6: ("µs",),
    1e-9: ("ns",),
    _DEGREE: ("deg", "deg/s", "dps"),
    _TURN_PER_MINUTE: ("rpm", "rev/min", "r/min"),
    2.0 * math.pi: ("rev", "rev/s", "rps"),
    60.0: ("min",),
}  # fmt: skip
_FACTOR_OF = {unit: factor for factor, units in _FACTORS.items() for unit in units}
_EXPONENT = r"\s*(?:\^|\*\*)?\s*[({]?\s*[-−]\s*1\s*[)}]?"
_SPELLINGS = tuple(
    (re.compile(pattern), symbol)
    for pattern, symbol in (
        (r"\\cdot", " "),
        (r"⁻¹", "^-1"),
        (r"°|º", "deg"),
        (rf"(seconds?|secs?|s|radians?|rad|minutes?|mins?){_EXPONENT}(?![\d.])", r"/\1"),
        (r"\bper\b", "/"),
        (r"milli", "m"),
        (r"micro|μ", "µ"),
        (r"nano", "n"),
        (r"newtons?", "n"),
        (r"met(re|er)s?", "m"),
        (r"rad(ian)?s?(?![a-z])", "rad"),
        (r"deg(ree)?s?(?![a-bd-z])", "deg"),
        (r"seconds?|secs?", "s"),
        (r"min(ute)?s?", "min"),
        (r"rev(olution)?s?|turns?", "rev"),
        (r"volts?", "v"),
        (r"celsius", "c"),
        (r"\bus\b", "µs"),
        (r"[\s.·⋅∙×*^_(){}-]", ""),
    )
)
"""Patterns of a unit in small letters, and what replaces each, in this order."""


def si_factor(unit: str) -> float | None:
    """Look up the factor of a unit to SI (s, rad, N m, V, degrees Celsius).

    Args:
        unit: The unit as it is written: `N·m`, `newton-metre`, `rad s^-1` or `radians per second`.

    Returns:
        The factor, or None for an unknown unit.
    """
    plain = unit.strip().lower()
    if plain in _FACTOR_OF:
        return _FACTOR_OF[plain]
    for pattern, symbol in _SPELLINGS:
        plain = pattern.sub(symbol, plain)
    return _FACTOR_OF.get(plain)


def split_unit(head: str) -> tuple[str, str]:
    """Split a column's head into name and unit: `time [ms]` into `time` and `ms`.

    Args:
        head: The head.

    Returns:
        Name and unit. The unit is empty if the brackets hold none, as in `q[0]`.
    """
    parts = re.fullmatch(r"(.+?)\s*[\[(]([^\[\]()]+)[\])]", head)
    if parts is None or parts[2].strip().isdigit() or si_factor(parts[2]) is None:
        return head, ""
    return parts[1], parts[2].strip()
