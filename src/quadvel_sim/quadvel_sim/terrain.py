"""The ground that the robot walks on: flat, slope, or rough (Perlin noise), as a geom and as a function.

Not for contact parameters: friction belongs to the feet (see `SimulatorConfig.friction`).
"""

from __future__ import annotations

from functools import cached_property

import attrs
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_sim.checks import number, whole_number

KINDS = ("flat", "slope", "rough")
GEOM_NAME = "ground"
_RESOLUTION = 0.05  # m between the points of the height grid
_LEVEL_RADIUS = 0.5  # m around the origin where rough ground stays level, so that a robot can be put down
_HILL_LENGTH = 8.0  # m, spacing of the lattice of hills
_BASE = 0.5  # m of solid ground below the lowest point


def perlin(
    x: NDArray[np.float64], y: NDArray[np.float64], wavelength: float, seed: int
) -> NDArray[np.float64]:
    """Gradient noise (Perlin 2002, quintic fade) at `x`, `y` (m, of one shape, >= 0), within [-1, 1].

    The lattice of random unit gradients has the spacing `wavelength` (m); equal seeds give equal ground as
    long as the largest coordinates are equal too.
    """
    u, v = x / wavelength, y / wavelength
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    angles = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (row.max() + 2, column.max() + 2))
    u, v = u - column, v - row

    def corner(i: int, j: int) -> NDArray[np.float64]:
        angle = angles[row + i, column + j]
        return np.asarray(np.cos(angle) * (u - j) + np.sin(angle) * (v - i))

    blend_x, blend_y = (t**3 * (t * (6.0 * t - 15.0) + 10.0) for t in (u, v))
    low = corner(0, 0) + blend_x * (corner(0, 1) - corner(0, 0))
    high = corner(1, 0) + blend_x * (corner(1, 1) - corner(1, 0))
    noise: NDArray[np.float64] = np.sqrt(2.0) * (low + blend_y * (high - low))
    return noise


@attrs.frozen
class Terrain:
    """Ground z = x tan(slope) + noise(x, y), world frame; around the origin the noise is zero."""

    kind: str = attrs.field(default="flat")
    slope: float = attrs.field(default=0.0, **number(-0.8, 0.8))
    """Inclination, rad; positive rises along +x. Zero where `kind` is flat."""
    roughness: float = attrs.field(default=0.06, **number(0.001, 1.0))
    """Bound of the noise of rough ground above and below the slope, m."""
    wavelength: float = attrs.field(default=0.6, **number(0.1, 10.0))
    """Spacing of the noise's lattice, m: about the distance from a hump to the next hollow."""
    hills: float = attrs.field(default=0.0, **number(0.0, 10.0))
    """Bound of the hills under the noise of rough ground, m: about 8 m from a hill to the next valley."""
    blend: float = attrs.field(default=0.5, **number(0.1, 100.0))
    """Distance over which rough ground grows from level to fully rough, m. Long: a field from easy to hard."""
    size: float = attrs.field(default=40.0, **number(4.0, 200.0))
    """Edge of the square of rough ground, m. Flat ground and slopes have no edge."""
    seed: int = attrs.field(default=0, **whole_number())
    """Seed of rough ground."""

    def __attrs_post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"Terrain.kind: found {self.kind!r}, expected one of {', '.join(KINDS)}")
        if self.kind == "flat" and self.slope != 0.0:
            raise ValueError(f"Terrain.slope: found {self.slope} rad with kind 'flat', expected 0")

    @cached_property
    def _heights(self) -> NDArray[np.float64]:
        """Heights of the grid (rows along y, columns along x), m."""
        points = round(self.size / _RESOLUTION) + 1
        axis = np.linspace(0.0, self.size, points)
        x, y = np.meshgrid(axis, axis)
        bumps = self.roughness * perlin(x, y, self.wavelength, self.seed)
        hills = self.hills * perlin(x, y, _HILL_LENGTH, self.seed + 1)
        x, y = x - 0.5 * self.size, y - 0.5 * self.size
        grown = np.clip((np.hypot(x, y) - _LEVEL_RADIUS) / self.blend, 0.0, 1.0)
        return np.asarray(x * np.tan(self.slope) + grown * (bumps + hills))

    @property
    def tilt(self) -> NDArray[np.float64]:
        """Orientation of the ground at the origin, quaternion (w, x, y, z), ground to world."""
        return np.array([np.cos(0.5 * self.slope), 0.0, -np.sin(0.5 * self.slope), 0.0])

    def height(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
        """Height of the ground (m) at `x`, `y` (m, world, shapes that broadcast); past the edge the rim's."""
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        if self.kind != "rough":
            return np.asarray(x * np.tan(self.slope))
        heights, last = self._heights, len(self._heights) - 1
        u, v = (np.clip((c + 0.5 * self.size) / _RESOLUTION, 0.0, last) for c in (x, y))
        column, row = (np.minimum(c.astype(int), last - 1) for c in (u, v))
        u, v = u - column, v - row
        # MuJoCo cuts each cell into two triangles along the diagonal from (0, 0) to (1, 1).
        here, right = heights[row, column], heights[row, column + 1]
        up, far = heights[row + 1, column], heights[row + 1, column + 1]
        below, above = u * (right - here) + v * (far - right), v * (up - here) + u * (far - up)
        return np.asarray(here + np.where(u > v, below, above))

    def triangles(self, size: float, step: float) -> NDArray[np.float64]:
        """The ground in a square about the origin, as people are shown it: each three of the vertices (N, 3), m, are a triangle.

        size: edge of the square, m. step: distance of its points, m.
        """
        axis = np.linspace(-0.5 * size, 0.5 * size, round(size / step) + 1)
        x, y = np.meshgrid(axis, axis)
        points = np.stack([x, y, self.height(x, y)], axis=-1)
        here, right, up, far = points[:-1, :-1], points[:-1, 1:], points[1:, :-1], points[1:, 1:]
        return np.stack([here, right, far, here, far, up], axis=2).reshape(-1, 3)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the ground to the robot's `spec` as the geom `ground` of the world body."""
        # The robot's geoms collide with contype 1 alone.
        common = {"name": GEOM_NAME, "contype": 1, "conaffinity": 0, "material": GEOM_NAME}
        if self.kind != "rough":
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.1], quat=self.tilt, **common
            )
            return
        heights = self._heights
        lowest, spread = heights.min(), np.ptp(heights)
        spec.add_hfield(
            name=GEOM_NAME,
            size=[0.5 * self.size, 0.5 * self.size, spread, _BASE],
            nrow=heights.shape[0],
            ncol=heights.shape[1],
            userdata=((heights - lowest) / spread).ravel(),
        )
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=GEOM_NAME, pos=[0.0, 0.0, lowest], **common
        )
