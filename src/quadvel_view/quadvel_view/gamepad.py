"""Velocity commands from a gamepad, through Linux's evdev, with a dead-man's button.

left shoulder   dead-man's button: the sticks act only while it is held
left stick      forward and sideways
right stick     turn
D-pad up, down  speed, in steps
B (circle)      STOP: the joints are damped until the release
start           release the STOP

After 5 s without any input the dead-man's button counts as released, because a pad that lost its
radio link sends nothing either. Press the button again to continue.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping

import attrs
import numpy as np

from quadvel_description.arrays import Array

from .keyboard import FIRST_STEP, MAX_TURN_RAD_S, SIDEWAYS_SHARE, SPEED_STEPS_M_S, TURN_PER_SPEED

# Of linux/input-event-codes.h.
SYNCHRONISATION, KEY, ABSOLUTE = 0, 1, 3
REPORT, DROPPED = 0, 3  # SYN_REPORT, SYN_DROPPED
DEAD_MAN, STOP, RELEASE = 0x136, 0x131, 0x13B  # BTN_TL, BTN_EAST, BTN_START
FORWARD, SIDE, YAW, DPAD_Y = 0x01, 0x00, 0x03, 0x11  # ABS_Y, ABS_X, ABS_RX, ABS_HAT0Y
STICKS = (FORWARD, SIDE, YAW)
SILENCE_TIMEOUT_S = 5.0
"""Time without an event after which the dead-man's button counts as released.

A held stick always jitters, and the kernel reports a lost radio link only after 20 s.
"""
DEAD_ZONE = 0.1
"""Half-width of the stick's neutral range, as a share of its travel."""


@attrs.frozen
class AxisRange:
    """Range of values of an axis.

    Attributes:
        lowest: Its smallest value.
        highest: Its largest value.
    """

    lowest: int
    highest: int

    def normalise(self, value: int) -> float:
        """Scale a value to -1 to 1, with a dead zone around the centre.

        Args:
            value: Raw value of the axis.

        Returns:
            sign(s) max(|s| - d, 0) / (1 - d), at most 1, for the raw share s and the dead zone d.
        """
        share = 2.0 * (value - self.lowest) / (self.highest - self.lowest) - 1.0
        beyond = max(abs(share) - DEAD_ZONE, 0.0) / (1.0 - DEAD_ZONE)
        return float(np.copysign(min(beyond, 1.0), share))


class Gamepad:
    """Tracks the state of a gamepad from its events.

    Args:
        spans: Ranges of the axes by their codes.
        clock: Returns the time of a monotonic clock, s.

    Raises:
        ValueError: A stick is missing.
    """

    def __init__(self, spans: Mapping[int, AxisRange], clock: Callable[[], float] = time.monotonic) -> None:
        missing = [f"{code:#x}" for code in STICKS if code not in spans]
        if missing:
            raise ValueError(f"the gamepad has no axis {', '.join(missing)}, expected two sticks")
        self._spans, self._clock = spans, clock
        self._shares = dict.fromkeys(STICKS, 0.0)
        self._held = self._events_lost = self._timed_out = False
        self._heard = clock()
        self._step = FIRST_STEP

    @property
    def speed(self) -> float:
        """Forward speed at full deflection, m/s."""
        return SPEED_STEPS_M_S[self._step]

    @property
    def timed_out(self) -> bool:
        """Whether the dead-man's button counts as released because of SILENCE_TIMEOUT_S."""
        return self._timed_out

    def handle_event(self, kind: int, code: int, value: int) -> str:
        """Process an event.

        After "restore" the caller passes the state of the device to `restore`; until then no
        velocity is commanded.

        Args:
            kind: Type of the event.
            code: Code of the event.
            value: Value of the event.

        Returns:
            "stop" or "release" for these buttons, "restore" after lost events, else "".
        """
        self._heard = self._clock()
        if (kind, code) == (SYNCHRONISATION, DROPPED):
            self._held, self._events_lost = False, True
        elif self._events_lost:  # the rest of an incomplete report is meaningless
            return "restore" if (kind, code) == (SYNCHRONISATION, REPORT) else ""
        elif kind == KEY and code == DEAD_MAN:
            self._hold(value != 0 and (self._held or value == 1))
        elif kind == KEY and value == 1:
            return {STOP: "stop", RELEASE: "release"}.get(code, "")
        elif kind == ABSOLUTE and code in self._shares:
            self._shares[code] = self._spans[code].normalise(value)
        elif kind == ABSOLUTE and code == DPAD_Y and value:
            self._step = min(max(self._step - value, 0), len(SPEED_STEPS_M_S) - 1)
        return ""

    def restore(self, keys: Collection[int], axes: Mapping[int, int]) -> str:
        """Set the state after lost events.

        Args:
            keys: Codes of the pressed buttons.
            axes: Raw values of the sticks by code.

        Returns:
            "stop" if the STOP button is pressed, else "".
        """
        self._events_lost = False
        self._shares = {code: self._spans[code].normalise(axes[code]) for code in STICKS}
        self._hold(DEAD_MAN in keys)
        return "stop" if STOP in keys else ""

    def velocity(self) -> Array | None:
        """Return the commanded velocity.

        Returns:
            vx, vy (m/s), wz (rad/s) while the dead-man's button is held, else None.
        """
        if self._held and self._clock() - self._heard > SILENCE_TIMEOUT_S:
            self._held, self._timed_out = False, True
        if not self._held:
            return None
        shares = np.array([-self._shares[code] for code in STICKS])
        return shares * [
            self.speed,
            SIDEWAYS_SHARE * self.speed,
            min(TURN_PER_SPEED * self.speed, MAX_TURN_RAD_S),
        ]

    def _hold(self, held: bool) -> None:
        """Set the dead-man's button."""
        self._held = held
        self._timed_out = self._timed_out and not held
