"""Parts of a world: walls, boxes, trees, tables, patches, hills, people.

`world` reads the list of parts from a file. Each part adds its own geoms; `persons` adds and moves
the people. Positions are in the
world frame, m; yaw in a file is in degrees.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, TypeAlias

import attrs
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.fields import field, refusal, to_array
from quadvel_sim.laser import LASER_VISIBLE_GROUP
from quadvel_sim.terrain import perlin

Height: TypeAlias = Callable[[ArrayLike, ArrayLike], Array]
"""Height of the ground (m) at x and y (m)."""
LOW_GEOM_GROUP = 0
"""MuJoCo group of low geoms that a laser does not see."""
SURFACE_PRIORITY = 2
"""MuJoCo priority of surfaces: above the feet's 1, so the surface sets the friction."""
MAX_HILL_SLOPE_DEG = 15.0
_FOUNDATION_DEPTH_M = 0.3  # of objects in the ground
_PATCH_SPACING_M = 0.05  # of the height points of a patch
_RIM_HEIGHT_M = 0.005  # of a patch above the ground around it
_TABLE_LEG_RADIUS_M, _BOARD_THICKNESS_M = 0.025, 0.03
_ARC_POINTS = 8  # of a rounded corner
_SOLREF = (0.01, 1.0)  # contact time constant (s) and damping ratio, as those of the robot
_BOX, _CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
_RGBA = {
    "grass": (0.33, 0.5, 0.25, 1.0),
    "gravel": (0.6, 0.57, 0.52, 1.0),
    "paved": (0.45, 0.46, 0.48, 1.0),
    "wall": (0.72, 0.68, 0.62, 1.0),
    "box": (0.55, 0.45, 0.35, 1.0),
    "tree": (0.36, 0.26, 0.17, 1.0),
    "table": (0.6, 0.48, 0.34, 1.0),
}


def _points(minimum: int) -> Any:
    """Declare a read-only array of points, (n, 2); no point follows itself."""

    def check(record: object, attribute: attrs.Attribute[Any], value: Any) -> None:
        shape = np.shape(value) if isinstance(value, np.ndarray) else ()
        if len(shape) != 2 or shape[0] < minimum or shape[1] != 2 or not np.isfinite(value).all():
            raise refusal(record, attribute.name, value, f"{minimum} or more points [x, y]")
        if minimum > 1 and not np.hypot(*np.diff(value, axis=0).T).all():
            raise refusal(record, attribute.name, value, "no point twice in a row")

    return attrs.field(converter=partial(to_array, None), validator=check)


@attrs.frozen
class Surface:
    """Properties of a ground surface.

    Attributes:
        friction: Sliding friction coefficient of a foot on it.
        bumps: Height of its bumps, m.
        wavelength: Distance between its bumps, m.
    """

    friction: float
    bumps: float
    wavelength: float


SURFACES = {
    "paved": Surface(0.8, 0.0, 1.0),
    "grass": Surface(0.6, 0.03, 0.35),
    "gravel": Surface(0.5, 0.02, 0.12),
}


@attrs.frozen(eq=False, kw_only=True)
class Wall:
    """Wall along a polyline.

    Attributes:
        points: Corners, (n, 2), m.
        height: Height, m.
        thickness: Thickness, m.
    """

    points: Array = _points(2)
    height: float = field(2.5, at_least=0.05, at_most=50.0)
    thickness: float = field(0.1, at_least=0.01, at_most=5.0)

    def add_to(self, spec: mujoco.MjSpec, name: str, height: Height) -> None:
        """Add a box per segment; boxes overlap at the corners.

        Args:
            spec: Model that is extended.
            name: Name of the geom or its prefix.
            height: Function from x, y (m) to the height of the ground, m.
        """
        for k, (begin, end) in enumerate(itertools.pairwise(self.points)):
            centre, side = 0.5 * (begin + end), end - begin
            size = [float(np.hypot(*side)) + self.thickness, self.thickness, self.height]
            part = f"{name}_{k}" if len(self.points) > 2 else name
            yaw = float(np.arctan2(side[1], side[0]))
            _add_upright(spec, part, _BOX, centre, size, yaw, _RGBA["wall"], height)


@attrs.frozen(eq=False, kw_only=True)
class Box:
    """Box on the ground: a bench, a kiosk, a parked car.

    Attributes:
        position: Centre, (2,), m.
        size: Length, width and height, (3,), m.
        yaw: Orientation, deg.
    """

    position: Array = field(size=2)
    size: Array = field(size=3, at_least=0.01)
    yaw: float = field(0.0, at_least=-360.0, at_most=360.0)

    def add_to(self, spec: mujoco.MjSpec, name: str, height: Height) -> None:
        """Add a box.

        Args:
            spec: Model that is extended.
            name: Name of the geom.
            height: Function from x, y (m) to the height of the ground, m.
        """
        yaw = np.radians(self.yaw)
        _add_upright(spec, name, _BOX, self.position, self.size, yaw, _RGBA["box"], height)


@attrs.frozen(eq=False, kw_only=True)
class Trees:
    """Trunks of trees, or posts, of one size.

    Attributes:
        positions: Centres, (n, 2), m.
        radius: Radius, m.
        height: Height, m.
    """

    positions: Array = _points(1)
    radius: float = field(0.15, at_least=0.01, at_most=3.0)
    height: float = field(3.0, at_least=0.05, at_most=50.0)

    def add_to(self, spec: mujoco.MjSpec, name: str, height: Height) -> None:
        """Add a cylinder per trunk.

        Args:
            spec: Model that is extended.
            name: Prefix of the geom names.
            height: Function from x, y (m) to the height of the ground, m.
        """
        size = [self.radius, self.radius, self.height]
        for k, position in enumerate(self.positions):
            _add_upright(spec, f"{name}_{k}", _CYLINDER, position, size, 0.0, _RGBA["tree"], height)


@attrs.frozen(eq=False, kw_only=True)
class Table:
    """Table: a board on four legs.

    Attributes:
        position: Centre, (2,), m.
        size: Length and width, (2,), m.
        height: Height of the upper side of the board, m.
        yaw: Orientation, deg.
    """

    position: Array = field(size=2)
    size: Array = field((1.4, 0.7), size=2, at_least=0.1)
    height: float = field(0.74, at_least=0.1, at_most=3.0)
    yaw: float = field(0.0, at_least=-360.0, at_most=360.0)

    def add_to(self, spec: mujoco.MjSpec, name: str, height: Height) -> None:
        """Add four cylinders and a box.

        Args:
            spec: Model that is extended.
            name: Name of the board, prefix of the legs' names.
            height: Function from x, y (m) to the height of the ground, m.
        """
        yaw = np.radians(self.yaw)
        for k, corner in enumerate(self.legs):
            size = [_TABLE_LEG_RADIUS_M, _TABLE_LEG_RADIUS_M, self.height - _BOARD_THICKNESS_M]
            _add_upright(spec, f"{name}_leg_{k}", _CYLINDER, corner, size, yaw, _RGBA["table"], height)
        below = float(height(*self.position)) + self.height - _BOARD_THICKNESS_M
        add_geom(
            spec,
            name,
            type=_BOX,
            pos=[*self.position, below + 0.5 * _BOARD_THICKNESS_M],
            size=[0.5 * self.size[0], 0.5 * self.size[1], 0.5 * _BOARD_THICKNESS_M],
            quat=_quaternion_about_z(yaw),
            rgba=_RGBA["table"],
        )

    @property
    def legs(self) -> Array:
        """Positions of the legs, (4, 2), m."""
        inwards = 0.5 * self.size - 2.0 * _TABLE_LEG_RADIUS_M
        corners = inwards * [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]
        return np.asarray(self.position + corners @ planar_rotation(np.radians(self.yaw)).T)


@attrs.frozen(eq=False, kw_only=True)
class Patch:
    """Rectangle of grass or gravel with bumps on level ground; lasers do not see it.

    Attributes:
        surface: `grass` or `gravel`.
        position: Centre, (2,), m.
        size: Length and width, (2,), m.
        yaw: Orientation, deg.
        friction: Sliding friction coefficient of a foot; None: that of the surface.
        bumps: Height of the bumps, m; None: that of the surface.
    """

    surface: str = field(one_of=["grass", "gravel"])
    position: Array = field(size=2)
    size: Array = field(size=2, at_least=0.5)
    yaw: float = field(0.0, at_least=-360.0, at_most=360.0)
    friction: float | None = field(None, at_least=0.05, at_most=3.0)
    bumps: float | None = field(None, at_least=0.006, at_most=0.2)

    def add_to(self, spec: mujoco.MjSpec, name: str, seed: int) -> None:
        """Add a height field.

        Args:
            spec: Model that is extended.
            name: Name of the geom.
            seed: Seed of the bumps.
        """
        heights = self._heights(seed)
        top = float(heights.max())
        spec.add_hfield(
            name=name,
            size=[0.5 * self.size[0], 0.5 * self.size[1], top, _FOUNDATION_DEPTH_M],
            nrow=heights.shape[0],
            ncol=heights.shape[1],
            userdata=(heights / top).ravel(),
        )
        friction = SURFACES[self.surface].friction if self.friction is None else self.friction
        add_geom(
            spec,
            name,
            type=mujoco.mjtGeom.mjGEOM_HFIELD,
            hfieldname=name,
            pos=[*self.position, 0.0],
            quat=_quaternion_about_z(np.radians(self.yaw)),
            friction=[friction, 0.02, 0.01],
            priority=SURFACE_PRIORITY,
            group=LOW_GEOM_GROUP,
            rgba=_RGBA[self.surface],
        )

    @property
    def point_count(self) -> int:
        """Number of points of the height field."""
        return int(np.prod(self.size / _PATCH_SPACING_M + 1.0))

    def _heights(self, seed: int) -> Array:
        """Return heights that grow from the rim to the bumps, m; rows across, columns along."""
        surface = SURFACES[self.surface]
        bumps = surface.bumps if self.bumps is None else self.bumps
        along, across = (
            np.linspace(0.0, length, round(length / _PATCH_SPACING_M) + 1) for length in self.size
        )
        x, y = np.meshgrid(along, across)
        inside = np.minimum(np.minimum(x, self.size[0] - x), np.minimum(y, self.size[1] - y))
        grown = np.clip(inside / surface.wavelength, 0.0, 1.0)
        noise = 0.5 * (1.0 + perlin(x, y, surface.wavelength, seed))
        return np.asarray(_RIM_HEIGHT_M + grown * (bumps - _RIM_HEIGHT_M) * noise)


@attrs.frozen(eq=False, kw_only=True)
class Hill:
    """Rectangular mound with a level top and slopes on all four sides.

    Raises:
        ValueError: A value is out of its range, or the slopes meet before they reach `height`.

    Attributes:
        position: Centre, (2,), m.
        size: Length and width at its base, (2,), m.
        height: Height of the level top, m.
        slope: Inclination of the slopes along its length, deg.
        sides: Inclination of the slopes across it, deg; None: the same as `slope`.
        yaw: Orientation, deg.
        surface: Surface that sets friction and colour.
    """

    position: Array = field(size=2)
    size: Array = field(size=2, at_least=1.0)
    height: float = field(at_least=0.02, at_most=20.0)
    slope: float = field(at_least=1.0, at_most=MAX_HILL_SLOPE_DEG)
    sides: float | None = field(None, at_least=1.0, at_most=60.0)
    yaw: float = field(0.0, at_least=-360.0, at_most=360.0)
    surface: str = field("paved", one_of=list(SURFACES))

    def __attrs_post_init__(self) -> None:
        highest = 0.98 * float((0.5 * self.size * self.steepness).min())
        if self.height > highest:
            raise ValueError(
                f"Hill.height: found {self.height:g}, expected at most {highest:.3g}, where its slopes meet"
            )

    @property
    def steepness(self) -> Array:
        """Slope along and across, (2,), m/m."""
        return np.tan(np.radians([self.slope, self.slope if self.sides is None else self.sides]))

    @property
    def top(self) -> Array:
        """Length and width of the level top, (2,), m."""
        return np.asarray(self.size - 2.0 * self.height / self.steepness)

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add a convex mesh between the corners of foot and top.

        Args:
            spec: Model that is extended.
            name: Name of the geom.
        """
        foot = 0.5 * self.size * [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]
        top = 0.5 * self.top * np.sign(foot)
        corners = np.vstack(
            [np.column_stack([foot, np.zeros(4)]), np.column_stack([top, np.full(4, self.height)])]
        )
        turn = np.eye(3)
        turn[:2, :2] = planar_rotation(np.radians(self.yaw))
        below = np.column_stack([foot, np.full(4, -_FOUNDATION_DEPTH_M)])
        vertices = np.vstack([below, corners]) @ turn.T + [*self.position, 0.0]
        spec.add_mesh(name=name, uservert=vertices.ravel())
        add_geom(
            spec,
            name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            friction=[SURFACES[self.surface].friction, 0.02, 0.01],
            priority=SURFACE_PRIORITY,
            rgba=_RGBA[self.surface],
        )


@attrs.frozen(eq=False, kw_only=True)
class Person:
    """A walking person; `persons` simulates it.

    Raises:
        ValueError: A value is out of its range, or `speeds` or `stops` are no ascending pairs.

    Attributes:
        way: Corners of the path, (n, 2), m.
        closed: Whether the path continues from the last point to the first; else the person stops
            at the last point.
        led: Whether the robot must follow this person.
        speed: Walking speed, m/s.
        pace: Relative amplitude of a slow variation of the speed.
        speeds: Pairs [m along the path, m/s]: the speed from there on.
        stops: Pairs [m along the path, s]: the person stands there for this time.
        begins_at: Start, m along the path.
        turn: Radius of the rounded corners, m.
        radius: Radius of a leg, m.
        apart: Lateral distance between the legs, m.
    """

    way: Array = _points(2)
    closed: bool = False
    led: bool = False
    speed: float = field(1.2, at_least=0.1, at_most=3.0)
    pace: float = field(0.0, at_least=0.0, at_most=0.9)
    speeds: Sequence[Sequence[float]] = ()
    stops: Sequence[Sequence[float]] = ()
    begins_at: float = field(0.0, at_least=0.0)
    turn: float = field(0.8, at_least=0.0, at_most=20.0)
    radius: float = field(0.06, at_least=0.03, at_most=0.15)
    apart: float = field(0.2, at_least=0.1, at_most=0.5)

    def __attrs_post_init__(self) -> None:
        for name, least in (("speeds", 0.1), ("stops", 0.0)):
            rows = getattr(self, name)
            try:
                table = np.array(rows, dtype=float).reshape(len(rows), 2)
                good = bool(
                    (np.isfinite(table) & (table >= [0.0, least])).all()
                    and (np.diff(table[:, 0]) > 0.0).all()
                )
            except (TypeError, ValueError):
                good = False
            if not good:
                raise ValueError(
                    f"Person.{name}: found {rows!r}, expected pairs of numbers, the first growing, "
                    f"the second {least:g} or more"
                )

    @cached_property
    def path(self) -> Array:
        """Path with rounded corners, (n, 2), m."""
        return round_corners(self.way, self.turn, self.closed)


def round_corners(way: Array, radius: float, closed: bool) -> Array:
    """Round the corners of a polyline with parabolas.

    Args:
        way: Polyline, (n, 2), m.
        radius: Approximate radius, m; a rounded corner uses at most half of each adjacent segment.
        closed: Whether the last point is connected to the first.

    Returns:
        Rounded polyline, (m, 2), m.
    """
    if radius == 0.0 or len(way) < 3:
        return way
    count = len(way)
    found: list[Array] = [] if closed else [way[:1]]
    for i in range(count) if closed else range(1, count - 1):
        before, here, after = way[i - 1], way[i], way[(i + 1) % count]
        back, ahead = before - here, after - here
        room = 0.49 * min(np.hypot(*back), np.hypot(*ahead))
        back, ahead = back / np.hypot(*back), ahead / np.hypot(*ahead)
        half = 0.5 * np.arccos(np.clip(back @ ahead, -1.0, 1.0))
        if half < 0.05 or half > 0.5 * np.pi - 1e-3:  # a U-turn, or straight on
            found.append(here[None])
            continue
        # Quadratic Bezier curve (a parabola) between points at distance r / tan(alpha / 2) from the
        # corner: p(t) = corner + cut ((1 - t)^2 back + t^2 ahead).
        cut = min(radius / np.tan(half), room)
        t = np.linspace(0.0, 1.0, _ARC_POINTS)[:, None]
        found.append(here + cut * ((1.0 - t) ** 2 * back + t**2 * ahead))
    return np.concatenate(found if closed else [*found, way[-1:]])


def _add_upright(
    spec: mujoco.MjSpec,
    name: str,
    kind: int,
    position: Array,
    size: ArrayLike,
    yaw: float,
    rgba: Sequence[float],
    height: Height,
) -> None:
    """Add a box, or a cylinder of radius `size[0]` and height `size[2]`, on the ground.

    It extends `_FOUNDATION_DEPTH_M` into the ground.
    """
    along, across, up = np.asarray(size, float)
    ground = float(height(*position))
    half = [along, 0.5 * (up + _FOUNDATION_DEPTH_M), 0.0]
    if kind == _BOX:
        half = [0.5 * along, 0.5 * across, 0.5 * (up + _FOUNDATION_DEPTH_M)]
    middle = [*position, ground + 0.5 * (up - _FOUNDATION_DEPTH_M)]
    add_geom(spec, name, type=kind, pos=middle, size=half, quat=_quaternion_about_z(yaw), rgba=rgba)


def add_geom(spec: mujoco.MjSpec, name: str, **geom: Any) -> None:
    """Add a geom to the world body that collides with the robot, whose geoms have contype 1.

    Args:
        spec: Model that is extended.
        name: Name of the geom.
        geom: Its other properties.
    """
    properties = {"contype": 1, "conaffinity": 0, "group": LASER_VISIBLE_GROUP, "solref": _SOLREF, **geom}
    spec.worldbody.add_geom(name=name, **properties)


def planar_rotation(yaw: float) -> Array:
    """Return the rotation matrix of an angle in the plane.

    Args:
        yaw: Angle, rad.

    Returns:
        Matrix, (2, 2).
    """
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def _quaternion_about_z(yaw: float) -> list[float]:
    """Return the quaternion (w, x, y, z) of a yaw angle in rad."""
    return [float(np.cos(0.5 * yaw)), 0.0, 0.0, float(np.sin(0.5 * yaw))]
