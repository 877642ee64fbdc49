"""A gamepad, by Linux's evdev: a velocity while its dead-man's button is held. What its buttons mean, and not which device it is.

left shoulder   dead-man's button: only while it is held do the sticks count
left stick      forward and sideways
right stick     turn
cross up, down  speed, in steps
B (circle)      STOP: the joints brake, and stay so
start           release the STOP
"""

from __future__ import annotations

from collections.abc import Mapping

import attrs
import numpy as np
from numpy.typing import NDArray

from .keyboard import FASTEST_TURN, FIRST_STEP, SIDEWAYS, STEPS, TURN

Array = NDArray[np.float64]

# Of linux/input-event-codes.h.
KEY, ABSOLUTE = 1, 3
DEAD_MAN, STOP, RELEASE = 0x136, 0x131, 0x13B  # BTN_TL, BTN_EAST, BTN_START
FORWARD, SIDE, YAW, CROSS = 0x01, 0x00, 0x03, 0x11  # ABS_Y, ABS_X, ABS_RX, ABS_HAT0Y
STICKS = (FORWARD, SIDE, YAW)
DEAD_ZONE = 0.1  # share of a stick's way that counts as its middle


@attrs.frozen
class Span:
    """The numbers between which an axis goes."""

    lowest: int
    highest: int

    def share(self, value: int) -> float:
        """-1 to 1, and 0 about the middle."""
        share = 2.0 * (value - self.lowest) / (self.highest - self.lowest) - 1.0
        beyond = max(abs(share) - DEAD_ZONE, 0.0) / (1.0 - DEAD_ZONE)
        return float(np.copysign(min(beyond, 1.0), share))


class Gamepad:
    """Follows one gamepad's events. spans: those of its axes, by their codes. Raises ValueError where sticks miss."""

    def __init__(self, spans: Mapping[int, Span]) -> None:
        missing = [f"{code:#x}" for code in STICKS if code not in spans]
        if missing:
            raise ValueError(f"the gamepad has no axis {', '.join(missing)}, expected two sticks")
        self._spans = spans
        self._shares = dict.fromkeys(STICKS, 0.0)
        self._held = False
        self._step = FIRST_STEP

    @property
    def speed(self) -> float:
        """m/s, straight on."""
        return STEPS[self._step]

    def follow(self, kind: int, code: int, value: int) -> str:
        """Take an event; "stop" or "release" where a button asked for that, else ""."""
        if kind == KEY and code == DEAD_MAN:
            self._held = bool(value)
        elif kind == KEY and value == 1:
            return {STOP: "stop", RELEASE: "release"}.get(code, "")
        elif kind == ABSOLUTE and code in self._shares:
            self._shares[code] = self._spans[code].share(value)
        elif kind == ABSOLUTE and code == CROSS and value:
            self._step = min(max(self._step - value, 0), len(STEPS) - 1)
        return ""

    def velocity(self) -> Array | None:
        """vx, vy (m/s), wz (rad/s) while the dead-man's button is held, else None."""
        if not self._held:
            return None
        shares = np.array([-self._shares[code] for code in STICKS])
        return shares * [self.speed, SIDEWAYS * self.speed, min(TURN * self.speed, FASTEST_TURN)]
