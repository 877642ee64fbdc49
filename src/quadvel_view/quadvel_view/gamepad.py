"""A gamepad, by Linux's evdev: a velocity while its dead-man's button is held. What its buttons mean, and not which device it is.

left shoulder   dead-man's button: only while it is held do the sticks count
left stick      forward and sideways
right stick     turn
cross up, down  speed, in steps
B (circle)      STOP: the joints brake, and stay so
start           release the STOP

Whatever is held perfectly still for 5 s counts as let go, as a pad whose radio link is lost sends nothing either;
the dead-man's button then has to be pressed again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping

import attrs
import numpy as np
from numpy.typing import NDArray

from .keyboard import FASTEST_TURN, FIRST_STEP, SIDEWAYS, STEPS, TURN

Array = NDArray[np.float64]

# Of linux/input-event-codes.h.
SYNCHRONISATION, KEY, ABSOLUTE = 0, 1, 3
REPORT, DROPPED = 0, 3  # SYN_REPORT, SYN_DROPPED
DEAD_MAN, STOP, RELEASE = 0x136, 0x131, 0x13B  # BTN_TL, BTN_EAST, BTN_START
FORWARD, SIDE, YAW, CROSS = 0x01, 0x00, 0x03, 0x11  # ABS_Y, ABS_X, ABS_RX, ABS_HAT0Y
STICKS = (FORWARD, SIDE, YAW)
SILENCE = 5.0
"""s without an event after which a pad counts as let go: a held stick trembles, and the kernel misses a lost radio link for 20 s"""
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
    """Follows one gamepad's events.

    Args:
        spans: those of its axes, by their codes.
        clock: seconds of a steady clock.

    Raises:
        ValueError: where sticks miss.
    """

    def __init__(self, spans: Mapping[int, Span], clock: Callable[[], float] = time.monotonic) -> None:
        missing = [f"{code:#x}" for code in STICKS if code not in spans]
        if missing:
            raise ValueError(f"the gamepad has no axis {', '.join(missing)}, expected two sticks")
        self._spans, self._clock = spans, clock
        self._shares = dict.fromkeys(STICKS, 0.0)
        self._held = self._events_lost = self._fell_silent = False
        self._heard = clock()
        self._step = FIRST_STEP

    @property
    def speed(self) -> float:
        """m/s, straight on."""
        return STEPS[self._step]

    @property
    def fell_silent(self) -> bool:
        """Whether the dead-man's button counts as let go since the pad sent nothing for SILENCE."""
        return self._fell_silent

    def follow(self, kind: int, code: int, value: int) -> str:
        """Take an event; "stop" or "release" where a button asked for that, "restore" where events were lost, else "".

        After "restore" the caller hands the state of the device to `restore`; until then nothing is held.
        """
        self._heard = self._clock()
        if (kind, code) == (SYNCHRONISATION, DROPPED):
            self._held, self._events_lost = False, True
        elif self._events_lost:  # the rest of a report that was cut says nothing
            return "restore" if (kind, code) == (SYNCHRONISATION, REPORT) else ""
        elif kind == KEY and code == DEAD_MAN:
            self._hold(value != 0 and (self._held or value == 1))
        elif kind == KEY and value == 1:
            return {STOP: "stop", RELEASE: "release"}.get(code, "")
        elif kind == ABSOLUTE and code in self._shares:
            self._shares[code] = self._spans[code].share(value)
        elif kind == ABSOLUTE and code == CROSS and value:
            self._step = min(max(self._step - value, 0), len(STEPS) - 1)
        return ""

    def restore(self, keys: Collection[int], axes: Mapping[int, int]) -> str:
        """Go on after lost events from the keys that are down and the values of the sticks; "stop" where STOP is down."""
        self._events_lost = False
        self._shares = {code: self._spans[code].share(axes[code]) for code in STICKS}
        self._hold(DEAD_MAN in keys)
        return "stop" if STOP in keys else ""

    def velocity(self) -> Array | None:
        """vx, vy (m/s), wz (rad/s) while the dead-man's button is held, else None."""
        if self._held and self._clock() - self._heard > SILENCE:
            self._held, self._fell_silent = False, True
        if not self._held:
            return None
        shares = np.array([-self._shares[code] for code in STICKS])
        return shares * [self.speed, SIDEWAYS * self.speed, min(TURN * self.speed, FASTEST_TURN)]

    def _hold(self, held: bool) -> None:
        self._held = held
        self._fell_silent = self._fell_silent and not held
