"""Velocity commands from the keys of a terminal, which repeats held keys but reports no release.

    w s     forward, back           + -    speed, in steps
    a d     turn left, right        space  STOP: damp the joints until r
    q e     sideways left, right    r      release the STOP; u stands up, x lies down; Ctrl-C ends

The arrows act as w, s, a and d. The robot moves while a key is held and stops when its repeats end.
"""

from __future__ import annotations

import math

import numpy as np

from quadvel_description.arrays import Array

KEY_DIRECTIONS = {
    "w": (1.0, 0.0, 0.0),
    "s": (-1.0, 0.0, 0.0),
    "a": (0.0, 0.0, 1.0),
    "d": (0.0, 0.0, -1.0),
    "q": (0.0, 1.0, 0.0),
    "e": (0.0, -1.0, 0.0),
}
"""Shares of vx, vy, wz by key."""
ARROWS = {"\x1b[A": "w", "\x1b[B": "s", "\x1b[D": "a", "\x1b[C": "d"}
SPEED_STEPS_M_S = (0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 1.6, 2.0)  # m/s
FIRST_STEP = 3
TURN_PER_SPEED, SIDEWAYS_SHARE, MAX_TURN_RAD_S = 1.6, 0.6, 2.0  # rad/s per m/s, share of the speed, rad/s
FIRST_REPEAT_TIMEOUT_S = 0.7
"""Time after the first press within which repeats begin; usual systems need 0.25 to 0.66 s."""
REPEAT_TIMEOUT_S = 0.2
"""Time within which one repeat follows another; usual systems need 0.03 to 0.1 s."""


class Keyboard:
    """Tracks the held key from key presses and their times."""

    def __init__(self) -> None:
        self._step = FIRST_STEP
        self._key = ""
        self._until = -math.inf

    @property
    def speed(self) -> float:
        """Forward speed, m/s."""
        return SPEED_STEPS_M_S[self._step]

    def press(self, key: str, now: float) -> None:
        """Process a key: it drives, changes the speed, or, if unknown, ends the motion.

        Args:
            key: Character or escape sequence.
            now: Time of a monotonic clock, s.
        """
        key = ARROWS.get(key, key)
        if key in ("+", "=", "-"):
            self._step = min(max(self._step + (-1 if key == "-" else 1), 0), len(SPEED_STEPS_M_S) - 1)
            return
        if key not in KEY_DIRECTIONS:
            self.release()
            return
        repeats = key == self._key and now <= self._until
        self._until = now + (REPEAT_TIMEOUT_S if repeats else FIRST_REPEAT_TIMEOUT_S)
        self._key = key

    def release(self) -> None:
        """Release the held key."""
        self._until = -math.inf

    def velocity(self, now: float) -> Array | None:
        """Return the commanded velocity.

        Args:
            now: Time of a monotonic clock, s.

        Returns:
            (3,) vx, vy (m/s), wz (rad/s) while a key is held, else None.
        """
        if now > self._until:
            return None
        scale = [self.speed, SIDEWAYS_SHARE * self.speed, min(TURN_PER_SPEED * self.speed, MAX_TURN_RAD_S)]
        return np.multiply(KEY_DIRECTIONS[self._key], scale)


def split_keys(text: str) -> list[str]:
    """Split terminal input into keys; an arrow has three characters.

    Args:
        text: Input of the terminal.

    Returns:
        Characters and escape sequences.
    """
    keys = []
    while text:
        length = 3 if text[:3] in ARROWS else 1
        keys.append(text[:length])
        text = text[length:]
    return keys
