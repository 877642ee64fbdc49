"""A 2-D laser scanner: what it is, its faults, and its rays in a MuJoCo model. What stands in the world is `world`'s matter.

A scan is taken at one instant: the time that a mirror needs to go round is left out.
"""

from __future__ import annotations

import attrs
import mujoco
import numpy as np
from numpy.typing import NDArray

from quadvel_sim.checks import number, numbers, whole_number

Array = NDArray[np.float64]

SEEN = 2
"""Group of the geoms that a laser sees; the robot's own and what lies low on the ground are of others"""
_EDGE = 0.1  # m, from one reading to the next, from which a beam may be split between two things
_BEYOND = 1.5  # ranges that rays go, so that what is behind an edge is known
_SUBTREE = 1  # flg_static of mj_multiRay: what stands in the world is seen, too


@attrs.frozen
class Scanner:
    """Rays and faults. angle_min and angle_increment in rad; noise: standard deviation of a range, m, of which `noise_share`
    grows with it; lost: share of rays without a reading; mixed: share of the rays at an edge that read something between
    the thing and what is behind it; nothing: what it says where there was nothing.
    """

    rays: int = 720
    angle_min: float = -np.pi
    angle_increment: float = np.deg2rad(0.5)
    range_max: float = 12.0
    noise: float = 0.01
    noise_share: float = 0.001
    lost: float = 0.002
    mixed: float = 0.3
    nothing: float = np.inf

    @property
    def angles(self) -> Array:
        """Of its rays, (rays,)."""
        return self.angle_min + self.angle_increment * np.arange(self.rays, dtype=float)

    def read(self, distances: Array, rng: np.random.Generator) -> Array:
        """Ranges (rays,), m, that it reports of the true distances (rays,), m, inf where there is nothing."""
        ranges = np.minimum(distances, 2.0 * self.range_max)
        before, after = np.roll(ranges, 1), np.roll(ranges, -1)
        if (self.rays + 0.5) * self.angle_increment < 2.0 * np.pi:  # no full circle
            before[0], after[-1] = ranges[0], ranges[-1]
        behind = np.maximum(before, after)
        at_edge = (behind - ranges > _EDGE) & (rng.random(self.rays) < self.mixed)
        ranges = np.where(at_edge, ranges + rng.random(self.rays) * (behind - ranges), ranges)
        ranges += (self.noise + self.noise_share * ranges) * rng.standard_normal(self.rays)
        silent = (ranges >= self.range_max) | (rng.random(self.rays) < self.lost)
        return np.where(silent, self.nothing, np.maximum(ranges, 0.0))


@attrs.frozen(eq=False, kw_only=True)
class Laser:
    """A scanner on the robot's trunk. Its frame: x ahead, z the axis about which it turns."""

    position: Array = attrs.field(default=(0.25, 0.0, 0.09), **numbers(3))
    """Of the point where its rays begin, in the trunk frame, m."""
    rotation: Array = attrs.field(default=0.0, **numbers(3))
    """Roll, pitch and yaw in the trunk frame, deg, about fixed axes; a positive pitch looks down."""
    field_of_view: float = attrs.field(default=270.0, **number(1.0, 360.0))
    """Angle that it sees, as much to the left as to the right, deg."""
    rays: int = attrs.field(default=1080, **whole_number(2))
    """Readings of a scan."""
    rate: float = attrs.field(default=20.0, **number(10.0, 40.0))
    """Scans a second, of which each takes a whole number of milliseconds."""
    range_max: float = attrs.field(default=25.0, **number(0.5, 200.0))
    """Distance, m, from which it sees nothing."""
    noise: float = attrs.field(default=0.01, **number(0.0, 1.0))
    """Standard deviation of a range, m."""
    noise_share: float = attrs.field(default=0.001, **number(0.0, 0.1))
    """By how much this grows a metre of the range, m."""
    lost: float = attrs.field(default=0.002, **number(0.0, 1.0))
    """Share of rays without a reading."""
    mixed: float = attrs.field(default=0.3, **number(0.0, 1.0))
    """Share of rays at an edge that read something between the thing and what is behind it."""

    def __attrs_post_init__(self) -> None:
        if not np.isclose(1000.0 / self.rate, self.period):
            raise ValueError(
                f"Laser.rate: found {self.rate:g} Hz, expected scans a whole number of ms apart: 10, 20, 25, 40"
            )

    @property
    def period(self) -> int:
        """From scan to scan, ms."""
        return round(1000.0 / self.rate)

    @property
    def quaternion(self) -> Array:
        """Orientation in the trunk frame, (4,), wxyz."""
        turned = np.zeros(4)
        mujoco.mju_euler2Quat(turned, np.radians(self.rotation), "XYZ")
        return turned

    @property
    def scanner(self) -> Scanner:
        """Its rays and faults."""
        view = np.radians(self.field_of_view)
        gaps = self.rays if self.field_of_view == 360.0 else self.rays - 1
        return Scanner(
            self.rays,
            -0.5 * view,
            view / gaps,
            self.range_max,
            self.noise,
            self.noise_share,
            self.lost,
            self.mixed,
        )


@attrs.frozen(eq=False)
class Scan:
    """One scan: the instant that it shows, s, ranges (rays,), m, inf where there was nothing, and the angles of the rays, rad."""

    time: float
    ranges: Array
    angle_min: float
    angle_increment: float


class RayCaster:
    """The rays of a laser on the trunk of the robot in `model`."""

    def __init__(self, model: mujoco.MjModel, laser: Laser) -> None:
        self.scanner = laser.scanner
        self._model, self._trunk = model, model.body("trunk").id
        self._position, rotation = laser.position, np.zeros(9)
        mujoco.mju_quat2Mat(rotation, laser.quaternion)
        angles = self.scanner.angles
        level = np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
        self._rays = level @ rotation.reshape(3, 3).T  # in the trunk frame
        self._groups = np.zeros(mujoco.mjNGROUP, dtype=np.uint8)
        self._groups[SEEN] = 1
        self._geoms = np.zeros(len(angles), dtype=np.int32)

    def distances(self, data: mujoco.MjData) -> Array:
        """How far the rays go in the present positions of `data`, (rays,), m; inf where they hit nothing."""
        frame = data.xmat[self._trunk].reshape(3, 3)
        start = data.xpos[self._trunk] + frame @ self._position
        rays = np.ascontiguousarray(self._rays @ frame.T)
        found = np.empty(len(rays))
        mujoco.mj_multiRay(
            self._model,
            data,
            start,
            rays.ravel(),
            self._groups,
            _SUBTREE,
            -1,
            self._geoms,
            found,
            None,
            len(rays),
            _BEYOND * self.scanner.range_max,
        )
        found[self._geoms < 0] = np.inf
        return found
