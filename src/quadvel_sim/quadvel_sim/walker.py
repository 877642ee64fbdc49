"""Gait model of a person for a laser at shin height: two circles that swing alternately.

It moves one person without physics; `persons` moves the bodies of a MuJoCo model by it. Positions
are in the world frame, m.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array

STANCE_FRACTION = 0.6
"""Share of a stride in which a foot stands."""
SHIN_SWING_RATIO = 0.75
"""Amplitude of the shin at the height of the laser, divided by that of the foot."""
SWING_TIME_CONSTANT_S = 0.2
"""Time constant with which the amplitude follows a change of speed."""


def _points(values: ArrayLike) -> Array:
    """Return a float array of points."""
    return np.asarray(values, float)


@attrs.define
class Walker:
    """Person that walks along a polyline.

    Attributes:
        way: Polyline, (n, 2), m.
        speed: Mean walking speed, m/s.
        stops: Time intervals (start, end) in s in which the person stands.
        pace: Relative amplitude of a slow variation of the speed.
        radius: Radius of a leg, m.
        apart: Lateral distance between the legs, m.
        phase: Phase of the stride, 0 to 1.
        time: Time since the start, s.
        travelled: Distance walked along the polyline, m.
        closed: Whether the path continues from the last point to the first; else the person stops
            at the last point.
        waiting: Whether the person must stand now.
        swing: Amplitude of a foot relative to the body, m.
    """

    way: Array = attrs.field(converter=_points)
    speed: float = 1.2
    stops: Sequence[tuple[float, float]] = ()
    pace: float = 0.0
    radius: float = 0.06
    apart: float = 0.2
    phase: float = 0.0
    time: float = 0.0
    travelled: float = 0.0
    closed: bool = False
    waiting: bool = False
    swing: float = attrs.field(default=0.0, init=False)
    _directions: Array = attrs.field(init=False)
    _starts: Array = attrs.field(init=False)
    _ends: Array = attrs.field(init=False)

    def step(self, dt: float) -> None:
        """Walk for a time step.

        Args:
            dt: Time step, s.
        """
        self.time += dt
        standing = (
            self.waiting
            or any(begin <= self.time < end for begin, end in self.stops)
            or (self.travelled >= self.length and not self.closed)
        )
        speed = 0.0 if standing else self.speed * (1.0 + self.pace * np.sin(1.3 * self.time))
        self.travelled += speed * dt
        # Stride period T(v) = 1.5 s - 0.3 v. A foot on the ground moves at -v relative to the body,
        # so its amplitude is v T STANCE_FRACTION / 2.
        period = 1.5 - 0.3 * min(speed, 2.0)
        self.swing += (0.5 * STANCE_FRACTION * speed * period - self.swing) * min(
            1.0, dt / SWING_TIME_CONSTANT_S
        )
        if speed > 0.0:
            self.phase = (self.phase + dt / period) % 1.0

    def __attrs_post_init__(self) -> None:
        way = np.vstack([self.way, self.way[:1]]) if self.closed else self.way
        pieces = np.diff(way, axis=0)
        lengths = np.hypot(*pieces.T)
        self._directions = pieces / lengths[:, None]
        self._ends = np.cumsum(lengths)
        self._starts = self._ends - lengths

    @property
    def length(self) -> float:
        """Length of the path or of a lap, m."""
        return float(self._ends[-1])

    @property
    def position(self) -> Array:
        """Position of the body, (2,), m."""
        return self._pose()[0]

    def _pose(self) -> tuple[Array, Array]:
        """Return position (2,) in m and unit direction (2,)."""
        along = self.travelled % self.length if self.closed else min(self.travelled, self.length)
        i = min(int(self._ends.searchsorted(along, side="right")), len(self._ends) - 1)
        direction = self._directions[i]
        return self.way[i] + (along - self._starts[i]) * direction, direction

    @property
    def heading(self) -> float:
        """Direction of walking, rad."""
        ahead = self._pose()[1]
        return float(np.arctan2(ahead[1], ahead[0]))

    @property
    def legs(self) -> Array:
        """Circles of left and right leg, (2, 3): x, y, radius, m."""
        body, ahead = self._pose()
        left = np.array([-ahead[1], ahead[0]])
        along = (
            SHIN_SWING_RATIO * self.swing * _swing_profile(np.array([self.phase, (self.phase + 0.5) % 1.0]))
        )
        side = 0.5 * self.apart * np.array([1.0, -1.0])
        return np.column_stack(
            [body + along[:, None] * ahead + side[:, None] * left, np.full(2, self.radius)]
        )


def _swing_profile(phase: Array) -> Array:
    """Return the relative position of a foot from 1 (ahead) to -1 (behind) over the phase.

    The stance moves linearly backward relative to the body; the swing is a half cosine.
    """
    air = (phase - STANCE_FRACTION) / (1.0 - STANCE_FRACTION)
    return np.where(phase < STANCE_FRACTION, 1.0 - 2.0 * phase / STANCE_FRACTION, -np.cos(np.pi * air))


def leg_circles(walkers: Sequence[Walker]) -> Array:
    """Return the legs of several people.

    Args:
        walkers: The n people.

    Returns:
        Circles, (2 n, 3): x, y, radius, m.
    """
    return np.concatenate([walker.legs for walker in walkers]) if walkers else np.zeros((0, 3))
