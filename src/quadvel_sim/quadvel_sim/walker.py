"""Persons who walk, as a laser at the height of their shins sees them: two circles that swing in turn."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

STANCE = 0.6  # of a stride, in which a foot stands
SHIN = 0.75  # swing of a shin, where it is measured, by that of its foot
SETTLING = 0.2  # s, in which the swing follows a change of pace


def _points(values: ArrayLike) -> Array:
    return np.asarray(values, float)


@attrs.define
class Walker:
    """A person on a way of straight pieces.

    way (n, 2): m, from one point to the next, at the last of which it stays, or, where the way is closed, from which it
    goes on to the first, round after round; travelled: m so far; speed: m/s; waiting: whether it stands; stops: (from, to)
    in s, times at which it stands; pace: share by which its speed changes, slowly, up and down; radius: m, of a leg;
    apart: m, of the legs from each other sideways.
    """

    way: Array = attrs.field(converter=_points)
    speed: float = 1.2
    stops: Sequence[tuple[float, float]] = ()
    pace: float = 0.0
    radius: float = 0.06
    apart: float = 0.2
    phase: float = 0.0  # of its stride, 0 to 1
    time: float = 0.0
    travelled: float = 0.0
    closed: bool = False
    waiting: bool = False
    swing: float = attrs.field(default=0.0, init=False)  # m, of a foot before and behind the body
    _directions: Array = attrs.field(init=False)  # (pieces, 2) of the way
    _begins: Array = attrs.field(init=False)  # (pieces,) m along the way
    _ends: Array = attrs.field(init=False)

    def step(self, dt: float) -> None:
        """Walk on for `dt` s."""
        self.time += dt
        standing = (
            self.waiting
            or any(begin <= self.time < end for begin, end in self.stops)
            or (self.travelled >= self.length and not self.closed)
        )
        speed = 0.0 if standing else self.speed * (1.0 + self.pace * np.sin(1.3 * self.time))
        self.travelled += speed * dt
        period = 1.5 - 0.3 * min(speed, 2.0)  # s a stride
        self.swing += (0.5 * STANCE * speed * period - self.swing) * min(1.0, dt / SETTLING)
        if speed > 0.0:
            self.phase = (self.phase + dt / period) % 1.0

    def __attrs_post_init__(self) -> None:
        way = np.vstack([self.way, self.way[:1]]) if self.closed else self.way
        pieces = np.diff(way, axis=0)
        lengths = np.hypot(*pieces.T)
        self._directions = pieces / lengths[:, None]
        self._ends = np.cumsum(lengths)
        self._begins = self._ends - lengths

    @property
    def length(self) -> float:
        """Of the way, or of a round, m."""
        return float(self._ends[-1])

    @property
    def position(self) -> Array:
        """Of the body, (2,) in m."""
        return self._place()[0]

    def _place(self) -> tuple[Array, Array]:
        """Position (2,) and direction (2,)."""
        along = self.travelled % self.length if self.closed else min(self.travelled, self.length)
        i = min(int(self._ends.searchsorted(along, side="right")), len(self._ends) - 1)
        direction = self._directions[i]
        return self.way[i] + (along - self._begins[i]) * direction, direction

    @property
    def heading(self) -> float:
        """Where it walks to, rad."""
        ahead = self._place()[1]
        return float(np.arctan2(ahead[1], ahead[0]))

    @property
    def legs(self) -> Array:
        """Circles (2, 3): x, y, radius, m."""
        body, ahead = self._place()
        left = np.array([-ahead[1], ahead[0]])
        along = SHIN * self.swing * _swing(np.array([self.phase, (self.phase + 0.5) % 1.0]))
        side = 0.5 * self.apart * np.array([1.0, -1.0])
        return np.column_stack(
            [body + along[:, None] * ahead + side[:, None] * left, np.full(2, self.radius)]
        )


def _swing(phase: Array) -> Array:
    """From 1, the foot put down ahead, to -1 as the body passes over it, and back through the air."""
    air = (phase - STANCE) / (1.0 - STANCE)
    return np.where(phase < STANCE, 1.0 - 2.0 * phase / STANCE, -np.cos(np.pi * air))


def circles(walkers: Sequence[Walker]) -> Array:
    """The legs of all, (2 n, 3)."""
    return np.concatenate([walker.legs for walker in walkers]) if walkers else np.zeros((0, 3))
