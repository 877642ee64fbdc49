"""2-D laser scanner: its parameters, its measurement errors, and ray casting in a MuJoCo model.

All rays of a scan are taken at one instant; the rotation time of the mirror is not modelled.
"""

from __future__ import annotations

import attrs
import mujoco
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.fields import field

LASER_VISIBLE_GROUP = 2
"""MuJoCo group of the geoms that a laser sees; links of the robot and patches of ground are in others."""
_MIN_EDGE_M = 0.1  # smallest difference of neighbouring ranges at which a beam may hit two objects
_RAY_LENGTH_FACTOR = 1.5  # length of a cast ray by range_max; finds the background of an edge
_INCLUDE_STATIC = 1  # flg_static of mj_multiRay: geoms of the world body count


@attrs.frozen
class Scanner:
    """Angles of the rays of a laser scanner, and its measurement errors.

    Attributes:
        rays: Number of rays.
        angle_min: Angle of the first ray, rad.
        angle_increment: Angle between two rays, rad.
        range_max: Range from which no echo is received, m.
        noise: Constant part of the standard deviation of a range, m.
        noise_share: Part of the standard deviation that is proportional to the range.
        lost: Share of rays without an echo.
        mixed: Share of the rays at an edge that measure a mixed range: a value between the object
            and its background.
        no_return: Value of a ray without an echo, m.
    """

    rays: int = 720
    angle_min: float = -np.pi
    angle_increment: float = np.deg2rad(0.5)
    range_max: float = 12.0
    noise: float = 0.01
    noise_share: float = 0.001
    lost: float = 0.002
    mixed: float = 0.3
    no_return: float = np.inf

    @property
    def angles(self) -> Array:
        """Angle of each ray, (rays,), rad."""
        return self.angle_min + self.angle_increment * np.arange(self.rays, dtype=float)

    def measure(self, distances: Array, rng: np.random.Generator) -> Array:
        """Simulate the measurement of a scan: mixed ranges at edges, noise, and lost rays.

        Args:
            distances: True distances, (rays,), m; inf for a ray that hits nothing.
            rng: Source of the measurement errors.

        Returns:
            Measured ranges, (rays,), m; `no_return` for a ray without an echo.
        """
        # Mixed ranges: r = d + U(0, 1) (d_behind - d), where d_behind is the farther neighbour.
        ranges = np.minimum(distances, 2.0 * self.range_max)
        before, after = np.roll(ranges, 1), np.roll(ranges, -1)
        if (self.rays + 0.5) * self.angle_increment < 2.0 * np.pi:  # no full circle
            before[0], after[-1] = ranges[0], ranges[-1]
        behind = np.maximum(before, after)
        at_edge = (behind - ranges > _MIN_EDGE_M) & (rng.random(self.rays) < self.mixed)
        ranges = np.where(at_edge, ranges + rng.random(self.rays) * (behind - ranges), ranges)
        # Noise: r += sigma(r) N(0, 1) with sigma(r) = noise + noise_share r.
        ranges += (self.noise + self.noise_share * ranges) * rng.standard_normal(self.rays)
        is_lost = (ranges >= self.range_max) | (rng.random(self.rays) < self.lost)
        return np.where(is_lost, self.no_return, np.maximum(ranges, 0.0))


@attrs.frozen(eq=False, kw_only=True)
class Laser:
    """Laser scanner on the robot's trunk. Its frame has x ahead and z along the axis of rotation.

    Raises:
        ValueError: A value is out of its range, or the scan period is not a whole number of ms.

    Attributes:
        position: Origin of the rays in the trunk frame, (3,), m.
        rotation: Roll, pitch and yaw in the trunk frame about fixed axes, (3,), deg; a positive
            pitch points downward.
        field_of_view: Angle that the scanner covers, symmetric to x, deg.
        rays: Number of rays of a scan.
        rate: Scans per second, Hz.
        range_max: Range from which no echo is received, m.
        noise: Constant part of the standard deviation of a range, m.
        noise_share: Part of the standard deviation that is proportional to the range.
        lost: Share of rays without an echo.
        mixed: Share of the rays at an edge that measure a mixed range.
    """

    position: Array = field((0.25, 0.0, 0.09), size=3)
    rotation: Array = field(0.0, size=3)
    field_of_view: float = field(270.0, at_least=1.0, at_most=360.0)
    rays: int = field(1080, at_least=2, whole=True)
    rate: float = field(20.0, at_least=10.0, at_most=40.0)
    range_max: float = field(25.0, at_least=0.5, at_most=200.0)
    noise: float = field(0.01, at_least=0.0, at_most=1.0)
    noise_share: float = field(0.001, at_least=0.0, at_most=0.1)
    lost: float = field(0.002, at_least=0.0, at_most=1.0)
    mixed: float = field(0.3, at_least=0.0, at_most=1.0)

    def __attrs_post_init__(self) -> None:
        if not np.isclose(1000.0 / self.rate, self.period):
            raise ValueError(
                f"Laser.rate: found {self.rate:g} Hz, expected scans a whole number of ms apart: 10, 20, 25, 40"
            )

    @property
    def period(self) -> int:
        """Time between two scans, ms."""
        return round(1000.0 / self.rate)

    @property
    def quaternion(self) -> Array:
        """Orientation in the trunk frame, (4,), (w, x, y, z)."""
        turned = np.zeros(4)
        mujoco.mju_euler2Quat(turned, np.radians(self.rotation), "XYZ")
        return turned

    @property
    def scanner(self) -> Scanner:
        """Rays and measurement errors of this laser."""
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
    """One scan of the laser.

    Attributes:
        time: Time of the scan, s.
        ranges: Measured ranges, (rays,), m; inf for a ray without an echo.
        angle_min: Angle of the first ray, rad.
        angle_increment: Angle between two rays, rad.
    """

    time: float
    ranges: Array
    angle_min: float
    angle_increment: float


class RayCaster:
    """Casts the rays of a laser on the trunk of the robot.

    Attributes:
        scanner: Rays and measurement errors.
    """

    def __init__(self, model: mujoco.MjModel, laser: Laser) -> None:
        """Compute the rays in the trunk frame.

        Args:
            model: Robot and world.
            laser: Laser on the trunk.
        """
        self.scanner = laser.scanner
        self._model, self._trunk = model, model.body("trunk").id
        self._position, rotation = laser.position, np.zeros(9)
        mujoco.mju_quat2Mat(rotation, laser.quaternion)
        angles = self.scanner.angles
        level = np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
        self._rays = level @ rotation.reshape(3, 3).T  # in the trunk frame
        self._groups = np.zeros(mujoco.mjNGROUP, dtype=np.uint8)
        self._groups[LASER_VISIBLE_GROUP] = 1
        self._geoms = np.zeros(len(angles), dtype=np.int32)

    def distances(self, data: mujoco.MjData) -> Array:
        """Cast all rays from the present pose of the laser.

        Args:
            data: State of the model; its positions must be up to date (`mj_kinematics`).

        Returns:
            Distance that each ray travels, (rays,), m; inf for a ray that hits nothing.
        """
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
            _INCLUDE_STATIC,
            -1,
            self._geoms,
            found,
            None,
            len(rays),
            _RAY_LENGTH_FACTOR * self.scanner.range_max,
        )
        found[self._geoms < 0] = np.inf
        return found
