"""Units that a file states in its head or in the row below, as factors to SI."""

from __future__ import annotations

import math
import re

_DEGREE = math.pi / 180.0
_TURN_PER_MINUTE = math.pi / 30.0
_FACTORS = {
    1.0: ("s", "sec", "second", "seconds", "rad", "radian", "radians", "rad/s", "rads", "nm", "nm/rad",
          "nms/rad", "v", "c", "degc", "1", "-"),
    1e-3: ("ms", "msec", "milliseconds", "mrad", "mrad/s", "mnm", "nmm", "mv"),
    1e-6: ("us", "µs", "usec", "microseconds"),
    1e-9: ("ns", "nsec", "nanoseconds"),
    _DEGREE: ("deg", "degree", "degrees", "deg/s", "degree/s", "degrees/s", "dps"),
    _TURN_PER_MINUTE: ("rpm",),
    2.0 * math.pi: ("rev", "turn", "turns", "rev/s", "turns/s"),
    60.0: ("min", "minutes"),
}  # fmt: skip
_FACTOR_OF = {unit: factor for factor, units in _FACTORS.items() for unit in units}


def si_factor(unit: str) -> float | None:
    """Look up the factor of a unit to SI (s, rad, N m, V, degrees Celsius).

    Args:
        unit: The unit as it is written.

    Returns:
        The factor, or None for an unknown unit.
    """
    plain = re.sub(r"[\s·*⋅^]|\\cdot", "", unit).replace("μ", "µ").lower()
    plain = plain.replace("s^-1", "/s").replace("°", "deg").replace("º", "deg").replace("sec", "s", 1)
    return _FACTOR_OF.get(plain, _FACTOR_OF.get(unit.strip().lower()))


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
