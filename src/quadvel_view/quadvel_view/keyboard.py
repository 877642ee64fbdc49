"""Keys of a terminal as hands that hold something. A terminal tells of no key that is let go: it repeats one that is held.

    w s     forward, back           + -    speed, in steps
    a d     turn left, right        space  STOP: the joints brake, and stay so until r
    q e     sideways left, right    r      release the STOP; u stands up, x lies down; Ctrl-C ends

The arrows do what w, s, a and d do. A held key counts until its repeats end.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WAYS = {
    "w": (1.0, 0.0, 0.0),
    "s": (-1.0, 0.0, 0.0),
    "a": (0.0, 0.0, 1.0),
    "d": (0.0, 0.0, -1.0),
    "q": (0.0, 1.0, 0.0),
    "e": (0.0, -1.0, 0.0),
}
ARROWS = {"\x1b[A": "w", "\x1b[B": "s", "\x1b[D": "a", "\x1b[C": "d"}
STEPS = (0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 1.6, 2.0)  # m/s
FIRST_STEP = 3
TURN, SIDEWAYS, FASTEST_TURN = 1.6, 0.6, 2.0  # rad/s per m/s, share of the speed, rad/s
UNTIL_REPEAT = 0.7
"""s after a key's first stroke within which its repeats begin: 0.25 to 0.66 on usual systems"""
BETWEEN_REPEATS = 0.2
"""s within which one repeat follows the other: 0.03 to 0.1"""


class Keyboard:
    """What is held now, told from strokes and the times (s) at which they came."""

    def __init__(self) -> None:
        self._step = FIRST_STEP
        self._key = ""
        self._until = -math.inf

    @property
    def speed(self) -> float:
        """m/s, straight on."""
        return STEPS[self._step]

    def stroke(self, key: str, now: float) -> None:
        """A key came: one that drives, or one that changes the speed; others are left alone, and let go what was held."""
        key = ARROWS.get(key, key)
        if key in ("+", "=", "-"):
            self._step = min(max(self._step + (-1 if key == "-" else 1), 0), len(STEPS) - 1)
            return
        if key not in WAYS:
            self.let_go()
            return
        repeats = key == self._key and now <= self._until
        self._until = now + (BETWEEN_REPEATS if repeats else UNTIL_REPEAT)
        self._key = key

    def let_go(self) -> None:
        """Nothing is held."""
        self._until = -math.inf

    def velocity(self, now: float) -> Array | None:
        """vx, vy (m/s), wz (rad/s) while a key is held, else None."""
        if now > self._until:
            return None
        scale = [self.speed, SIDEWAYS * self.speed, min(TURN * self.speed, FASTEST_TURN)]
        return np.multiply(WAYS[self._key], scale)


def strokes(text: str) -> list[str]:
    """What a terminal sent, cut into keys; an arrow is three characters."""
    keys = []
    while text:
        length = 3 if text[:3] in ARROWS else 1
        keys.append(text[:length])
        text = text[length:]
    return keys
