"""Ground: flat, slope or rough (Perlin noise), as a MuJoCo geom and as a function.

Friction is a property of the feet, see `SimulatorConfig.friction`.
"""

from __future__ import annotations

from functools import cached_property

import attrs
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.fields import field

KINDS = ("flat", "slope", "rough")
GEOM_NAME = "ground"
_GRID_SPACING_M = 0.05  # of the height grid
_LEVEL_RADIUS_M = 0.5  # rough ground is level around the origin, where the robot starts
_HILL_SPACING_M = 8.0  # of the lattice of hills
_BASE_THICKNESS_M = 0.5  # of solid ground below the lowest point


def perlin(x: Array, y: Array, wavelength: float, seed: int) -> Array:
    """Compute 2-D gradient noise with quintic fade.

    K. Perlin, Improving noise, ACM Transactions on Graphics 21 (3), 2002.

    Args:
        x: Coordinates, m, >= 0.
        y: Coordinates of the same shape, m, >= 0.
        wavelength: Spacing of the lattice of random unit gradients, m.
        seed: Seed of the gradients. Equal seeds give equal noise if the largest coordinates are
            equal.

    Returns:
        Noise in [-1, 1], shape of `x`.
    """
    # At the lattice corners (j, i): n_ij = g_ij . (u - j, v - i), blended by
    # fade(t) = 6 t^5 - 15 t^4 + 10 t^3; sqrt(2) scales the result to [-1, 1].
    u, v = x / wavelength, y / wavelength
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    angles = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (row.max() + 2, column.max() + 2))
    u, v = u - column, v - row

    def corner(i: int, j: int) -> Array:
        angle = angles[row + i, column + j]
        return np.asarray(np.cos(angle) * (u - j) + np.sin(angle) * (v - i))

    blend_x, blend_y = (t**3 * (t * (6.0 * t - 15.0) + 10.0) for t in (u, v))
    low = corner(0, 0) + blend_x * (corner(0, 1) - corner(0, 0))
    high = corner(1, 0) + blend_x * (corner(1, 1) - corner(1, 0))
    noise: Array = np.sqrt(2.0) * (low + blend_y * (high - low))
    return noise


DEFAULT_SLOPE_RAD = 0.175
"""Inclination of a slope for which none is given: 10 degrees."""


@attrs.frozen
class Terrain:
    """Ground z = tan(slope) s + noise(x, y) in the world frame; the noise is zero near the origin.

    s is the distance from the origin along `direction`. On a ramp it counts from `level` on, and the
    ground before it is level.

    Raises:
        ValueError: A value is out of its range, or flat ground has a slope.

    Attributes:
        kind: `flat`, `slope` or `rough`.
        slope: Inclination, rad; positive rises along `direction`. Zero for flat ground.
        roughness: Amplitude of the noise of rough ground, m.
        wavelength: Lattice spacing of the noise, m: about the distance from a hump to the next
            hollow.
        hills: Amplitude of long hills under the noise of rough ground, m; about 8 m from hill to
            valley.
        blend: Distance over which rough ground grows from level to its full roughness, m. A long
            distance gives a field from easy to hard.
        size: Edge of the square of rough ground or of a ramp, m. Flat ground and slopes are infinite.
        seed: Seed of rough ground.
        direction: Direction in which a slope rises, rad, from +x to the left.
        level: Level ground before a ramp begins, m; 0 for a slope that has no beginning.
    """

    kind: str = field("flat", one_of=KINDS)
    slope: float = field(0.0, at_least=-0.8, at_most=0.8)
    roughness: float = field(0.06, at_least=0.001, at_most=1.0)
    wavelength: float = field(0.6, at_least=0.1, at_most=10.0)
    hills: float = field(0.0, at_least=0.0, at_most=10.0)
    blend: float = field(0.5, at_least=0.1, at_most=100.0)
    size: float = field(40.0, at_least=4.0, at_most=200.0)
    seed: int = field(0, at_least=0, whole=True)
    direction: float = field(0.0, at_least=-np.pi, at_most=np.pi)
    level: float = field(0.0, at_least=0.0, at_most=100.0)

    def __attrs_post_init__(self) -> None:
        if self.kind == "flat" and self.slope != 0.0:
            raise ValueError(f"Terrain.slope: found {self.slope} rad with kind 'flat', expected 0")

    @property
    def is_grid(self) -> bool:
        """Whether the ground is a height field, not a plane."""
        return self.kind == "rough" or (self.level > 0.0 and self.slope != 0.0)

    def _rise(self, x: Array, y: Array) -> Array:
        """Height of slope or ramp, m."""
        along = np.cos(self.direction) * x + np.sin(self.direction) * y
        if self.level > 0.0:
            along = np.maximum(along - self.level, 0.0)
        return np.asarray(np.tan(self.slope) * along)

    @cached_property
    def _heights(self) -> Array:
        """Heights of the grid, m; rows along y, columns along x."""
        points = round(self.size / _GRID_SPACING_M) + 1
        axis = np.linspace(0.0, self.size, points)
        x, y = np.meshgrid(axis, axis)
        rise = self._rise(x - 0.5 * self.size, y - 0.5 * self.size)
        if self.kind != "rough":
            return rise
        bumps = self.roughness * perlin(x, y, self.wavelength, self.seed)
        hills = self.hills * perlin(x, y, _HILL_SPACING_M, self.seed + 1)
        distance = np.hypot(x - 0.5 * self.size, y - 0.5 * self.size)
        grown = np.clip((distance - _LEVEL_RADIUS_M) / self.blend, 0.0, 1.0)
        return np.asarray(rise + grown * (bumps + hills))

    @property
    def tilt(self) -> Array:
        """Orientation of the ground at the origin, ground to world, (4,), (w, x, y, z)."""
        half = 0.5 * self.slope if self.level == 0.0 else 0.0
        axis = np.array([np.sin(self.direction), -np.cos(self.direction), 0.0])
        return np.concatenate([[np.cos(half)], np.sin(half) * axis])

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Interpolate the height of the ground as MuJoCo's height field does.

        Args:
            x: Coordinates in the world frame, m.
            y: Coordinates, m; shapes of `x` and `y` broadcast.

        Returns:
            Height, m; beyond the edge of a height field the height of the edge.
        """
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        if not self.is_grid:
            return self._rise(x, y)
        heights, last = self._heights, len(self._heights) - 1
        u, v = (np.clip((c + 0.5 * self.size) / _GRID_SPACING_M, 0.0, last) for c in (x, y))
        column, row = (np.minimum(c.astype(int), last - 1) for c in (u, v))
        u, v = u - column, v - row
        # MuJoCo cuts each cell into two triangles along the diagonal from (0, 0) to (1, 1).
        here, right = heights[row, column], heights[row, column + 1]
        up, far = heights[row + 1, column], heights[row + 1, column + 1]
        below, above = u * (right - here) + v * (far - right), v * (up - here) + u * (far - up)
        return np.asarray(here + np.where(u > v, below, above))

    def triangles(self, size: float, step: float) -> Array:
        """Return the ground in a square about the origin as triangles for display.

        Args:
            size: Edge of the square, m.
            step: Distance of the grid points, m.

        Returns:
            Vertices, (N, 3), m; three consecutive ones are a triangle.
        """
        axis = np.linspace(-0.5 * size, 0.5 * size, round(size / step) + 1)
        x, y = np.meshgrid(axis, axis)
        points = np.stack([x, y, self.height(x, y)], axis=-1)
        here, right, up, far = points[:-1, :-1], points[:-1, 1:], points[1:, :-1], points[1:, 1:]
        return np.stack([here, right, far, here, far, up], axis=2).reshape(-1, 3)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the ground to a model as the geom `ground` of the world body.

        Args:
            spec: Model that is extended.
        """
        # The robot's geoms collide with contype 1 only.
        common = {"name": GEOM_NAME, "contype": 1, "conaffinity": 0, "material": GEOM_NAME}
        if not self.is_grid:
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.1], quat=self.tilt, **common
            )
            return
        heights = self._heights
        lowest, spread = heights.min(), np.ptp(heights)
        spec.add_hfield(
            name=GEOM_NAME,
            size=[0.5 * self.size, 0.5 * self.size, spread, _BASE_THICKNESS_M],
            nrow=heights.shape[0],
            ncol=heights.shape[1],
            userdata=((heights - lowest) / spread).ravel(),
        )
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=GEOM_NAME, pos=[0.0, 0.0, lowest], **common
        )
