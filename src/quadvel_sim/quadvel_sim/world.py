"""World around the robot from a YAML file: ground, walls, trees, tables, people, laser.

The robot starts at the origin on level ground and faces along x. This module describes a world and
adds its geoms to a model; `surroundings` and `persons` simulate what changes with time.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import attrs
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.bounded_yaml import read_yaml
from quadvel_sim.checks import number, numbers, one_of, or_none, points, truth_value, whole_number
from quadvel_sim.laser import LASER_VISIBLE_GROUP, Laser
from quadvel_sim.terrain import GEOM_NAME, perlin

SCHEMA = 1
WORLDS_FOLDER = Path(__file__).parent / "worlds"
SHIPPED_WORLDS = ("corridor", "park", "campus")
LOW_GEOM_GROUP = 0
"""MuJoCo group of low geoms that a laser does not see."""
MAX_SOLIDS = 2_000
"""Largest number of boxes, cylinders and meshes: more make contacts and rays too slow."""
MAX_PERSONS = 50
MAX_HEIGHT_POINTS = 4_000_000
"""Largest number of height points of all patches: 100 m x 100 m."""
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


@attrs.frozen
class Surface:
    """Properties of a ground surface.

    Attributes:
        friction: Sliding friction coefficient of a foot on it.
        bumps: Height of its bumps, m.
        wavelength: Distance of its bumps, m.
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

    points: Array = attrs.field(**points(2))
    height: float = attrs.field(default=2.5, **number(0.05, 50.0))
    thickness: float = attrs.field(default=0.1, **number(0.01, 5.0))

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """Add a box per segment; boxes overlap at the corners.

        Args:
            spec: Model that is extended.
            name: Name of the geom or its prefix.
            world: World with the height of the ground.
        """
        for k, (begin, end) in enumerate(itertools.pairwise(self.points)):
            centre, side = 0.5 * (begin + end), end - begin
            size = [float(np.hypot(*side)) + self.thickness, self.thickness, self.height]
            part = f"{name}_{k}" if len(self.points) > 2 else name
            yaw = float(np.arctan2(side[1], side[0]))
            world._add_upright(spec, part, _BOX, centre, size, yaw, _RGBA["wall"])


@attrs.frozen(eq=False, kw_only=True)
class Box:
    """Box on the ground: a bench, a kiosk, a parked car.

    Attributes:
        position: Centre, (2,), m.
        size: Length, width and height, (3,), m.
        yaw: Orientation, deg.
    """

    position: Array = attrs.field(**numbers(2))
    size: Array = attrs.field(**numbers(3, low=0.01))
    yaw: float = attrs.field(default=0.0, **number(-360.0, 360.0))

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """Add a box.

        Args:
            spec: Model that is extended.
            name: Name of the geom.
            world: World with the height of the ground.
        """
        yaw = np.radians(self.yaw)
        world._add_upright(spec, name, _BOX, self.position, self.size, yaw, _RGBA["box"])


@attrs.frozen(eq=False, kw_only=True)
class Trees:
    """Trunks of trees, or posts, of one size.

    Attributes:
        positions: Centres, (n, 2), m.
        radius: Radius, m.
        height: Height, m.
    """

    positions: Array = attrs.field(**points(1))
    radius: float = attrs.field(default=0.15, **number(0.01, 3.0))
    height: float = attrs.field(default=3.0, **number(0.05, 50.0))

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """Add a cylinder per trunk.

        Args:
            spec: Model that is extended.
            name: Prefix of the geom names.
            world: World with the height of the ground.
        """
        size = [self.radius, self.radius, self.height]
        for k, position in enumerate(self.positions):
            world._add_upright(spec, f"{name}_{k}", _CYLINDER, position, size, 0.0, _RGBA["tree"])


@attrs.frozen(eq=False, kw_only=True)
class Table:
    """Table: a board on four legs.

    Attributes:
        position: Centre, (2,), m.
        size: Length and width, (2,), m.
        height: Height of the upper side of the board, m.
        yaw: Orientation, deg.
    """

    position: Array = attrs.field(**numbers(2))
    size: Array = attrs.field(default=(1.4, 0.7), **numbers(2, low=0.1))
    height: float = attrs.field(default=0.74, **number(0.1, 3.0))
    yaw: float = attrs.field(default=0.0, **number(-360.0, 360.0))

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """Add four cylinders and a box.

        Args:
            spec: Model that is extended.
            name: Name of the board, prefix of the legs' names.
            world: World with the height of the ground.
        """
        yaw = np.radians(self.yaw)
        for k, corner in enumerate(self.legs):
            size = [_TABLE_LEG_RADIUS_M, _TABLE_LEG_RADIUS_M, self.height - _BOARD_THICKNESS_M]
            world._add_upright(spec, f"{name}_leg_{k}", _CYLINDER, corner, size, yaw, _RGBA["table"])
        below = float(world.height(*self.position)) + self.height - _BOARD_THICKNESS_M
        world._add_geom(
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
        return np.asarray(self.position + corners @ _rotation(np.radians(self.yaw)).T)


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

    surface: str = attrs.field(**one_of(["grass", "gravel"]))
    position: Array = attrs.field(**numbers(2))
    size: Array = attrs.field(**numbers(2, low=0.5))
    yaw: float = attrs.field(default=0.0, **number(-360.0, 360.0))
    friction: float | None = attrs.field(default=None, **or_none(number(0.05, 3.0)))
    bumps: float | None = attrs.field(default=None, **or_none(number(0.006, 0.2)))

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """Add a height field.

        Args:
            spec: Model that is extended.
            name: Name of the geom.
            world: World with the seed of the bumps.
        """
        heights = self._heights(world.seed + 1 + world.patches.index(self))
        top = float(heights.max())
        spec.add_hfield(
            name=name,
            size=[0.5 * self.size[0], 0.5 * self.size[1], top, _FOUNDATION_DEPTH_M],
            nrow=heights.shape[0],
            ncol=heights.shape[1],
            userdata=(heights / top).ravel(),
        )
        friction = SURFACES[self.surface].friction if self.friction is None else self.friction
        world._add_geom(
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
    def point_count(self) -> float:
        """Number of points of the height field."""
        return float(np.prod(self.size / _PATCH_SPACING_M + 1.0))

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
        ValueError: A value is out of its range, or opposite slopes meet below `height`.

    Attributes:
        position: Centre, (2,), m.
        size: Length and width of the foot, (2,), m.
        height: Height of the level top, m.
        slope: Inclination of the slopes along its length, deg.
        sides: Inclination of the slopes across it, deg; None: the same as `slope`.
        yaw: Orientation, deg.
        surface: Surface that sets friction and colour.
    """

    position: Array = attrs.field(**numbers(2))
    size: Array = attrs.field(**numbers(2, low=1.0))
    height: float = attrs.field(**number(0.02, 20.0))
    slope: float = attrs.field(**number(1.0, MAX_HILL_SLOPE_DEG))
    sides: float | None = attrs.field(default=None, **or_none(number(1.0, 60.0)))
    yaw: float = attrs.field(default=0.0, **number(-360.0, 360.0))
    surface: str = attrs.field(default="paved", **one_of(list(SURFACES)))

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

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """Add a convex mesh between the corners of foot and top.

        Args:
            spec: Model that is extended.
            name: Name of the geom.
            world: The world.
        """
        foot = 0.5 * self.size * [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]
        top = 0.5 * self.top * np.sign(foot)
        corners = np.vstack(
            [np.column_stack([foot, np.zeros(4)]), np.column_stack([top, np.full(4, self.height)])]
        )
        turn = np.eye(3)
        turn[:2, :2] = _rotation(np.radians(self.yaw))
        below = np.column_stack([foot, np.full(4, -_FOUNDATION_DEPTH_M)])
        vertices = np.vstack([below, corners]) @ turn.T + [*self.position, 0.0]
        spec.add_mesh(name=name, uservert=vertices.ravel())
        world._add_geom(
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

    way: Array = attrs.field(**points(2))
    closed: bool = attrs.field(default=False, **truth_value())
    led: bool = attrs.field(default=False, **truth_value())
    speed: float = attrs.field(default=1.2, **number(0.1, 3.0))
    pace: float = attrs.field(default=0.0, **number(0.0, 0.9))
    speeds: Sequence[Sequence[float]] = ()
    stops: Sequence[Sequence[float]] = ()
    begins_at: float = attrs.field(default=0.0, **number(0.0))
    turn: float = attrs.field(default=0.8, **number(0.0, 20.0))
    radius: float = attrs.field(default=0.06, **number(0.03, 0.15))
    apart: float = attrs.field(default=0.2, **number(0.1, 0.5))

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


_PARTS: Mapping[str, type] = {
    "walls": Wall,
    "boxes": Box,
    "trees": Trees,
    "tables": Table,
    "patches": Patch,
    "hills": Hill,
    "persons": Person,
}


@attrs.frozen(eq=False, kw_only=True)
class World:
    """Everything around the robot, and its laser.

    Raises:
        ValueError: A part is out of its range, or there are too many parts.

    Attributes:
        name: Name of the world.
        seed: Seed of the bumps and of the laser's errors.
        laser: Laser on the robot.
        walls: Walls.
        boxes: Boxes.
        trees: Indices of trees.
        tables: Tables.
        patches: Patches of grass or gravel.
        hills: Hills.
        persons: People; the one that the robot must follow (`led`) is the first.
    """

    name: str = "world"
    seed: int = attrs.field(default=0, **whole_number())
    laser: Laser = attrs.field(factory=Laser)
    walls: Sequence[Wall] = ()
    boxes: Sequence[Box] = ()
    trees: Sequence[Trees] = ()
    tables: Sequence[Table] = ()
    patches: Sequence[Patch] = ()
    hills: Sequence[Hill] = ()
    persons: Sequence[Person] = ()

    def __attrs_post_init__(self) -> None:
        self._check_limit(
            "parts, pieces of walls and legs of tables counted each", self.solid_count, MAX_SOLIDS
        )
        self._check_limit("persons", len(self.persons), MAX_PERSONS)
        self._check_limit(
            "points of bumps", sum(patch.point_count for patch in self.patches), MAX_HEIGHT_POINTS
        )
        led = [i for i, person in enumerate(self.persons) if person.led]
        if len(led) > 1 or led[1:] or (led and led[0] != 0):
            raise ValueError(f"persons: found `led` at indices {led}, expected index 0 or none")
        if float(self.height(0.0, 0.0)) != 0.0:
            raise ValueError("hills: found one at the origin, expected level ground where the robot starts")

    @staticmethod
    def _check_limit(what: str, found: float, most: int) -> None:
        """Refuse a count above its limit."""
        if found > most:
            raise ValueError(f"found {found:.0f} {what}, expected {most} at most")

    @property
    def solid_count(self) -> int:
        """Number of geoms of obstacles and hills."""
        walls = sum(len(wall.points) - 1 for wall in self.walls)
        trees = sum(len(group.positions) for group in self.trees)
        return walls + len(self.boxes) + trees + 5 * len(self.tables) + len(self.hills)

    @classmethod
    def load(cls, source: str | Path) -> World:
        """Load a world from a YAML file.

        Args:
            source: Path of a file, or the name of a shipped world.

        Returns:
            The world.

        Raises:
            ValueError: The file cannot be read, or a field is wrong; the message names file, field,
                value found and expectation.
        """
        path = WORLDS_FOLDER / f"{source}.yaml" if str(source) in SHIPPED_WORLDS else Path(source)
        try:
            document = read_yaml(path, "a YAML file of a world")
        except OSError as error:
            shipped = ", ".join(SHIPPED_WORLDS)
            raise ValueError(
                f"world {source}: {error.strerror}, expected a YAML file or one of {shipped}"
            ) from None
        try:
            return _parse_world(document, path.stem)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Compute the height of the ground without the bumps of patches.

        Args:
            x: Coordinates, m.
            y: Coordinates, m; shapes of `x` and `y` broadcast.

        Returns:
            Height, m.
        """
        place = np.stack(np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float)), axis=-1)
        if not self.hills:
            return np.zeros(place.shape[:-1])
        centre, turn, half, steepness, top = self._hill_arrays
        away = ((place[..., None, :] - centre)[..., None, :] @ turn)[
            ..., 0, :
        ]  # (..., hills, 2), along and across each
        rise = ((half - np.abs(away)) * steepness).min(-1)
        return np.asarray(np.minimum(rise, top).max(-1).clip(0.0))

    @cached_property
    def _hill_arrays(self) -> tuple[Array, ...]:
        """Centres, rotations, half sizes, slopes and heights of all hills."""
        return (
            np.array([hill.position for hill in self.hills]),
            np.array([_rotation(np.radians(hill.yaw)) for hill in self.hills]),
            np.array([0.5 * hill.size for hill in self.hills]),
            np.array([hill.steepness for hill in self.hills]),
            np.array([hill.height for hill in self.hills]),
        )

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add all static parts to a model, as geoms of the world body named after the parts.

        Args:
            spec: Model that is extended.
        """
        self._add_geom(
            spec,
            GEOM_NAME,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0.0, 0.0, 0.1],
            material=GEOM_NAME,
            rgba=None,
        )
        for kind, record in _PARTS.items():
            if record is not Person:
                for i, part in enumerate(getattr(self, kind)):
                    part.add_to(spec, f"{record.__name__.lower().removesuffix('s')}_{i}", self)

    def _add_upright(
        self,
        spec: mujoco.MjSpec,
        name: str,
        kind: int,
        position: Array,
        size: ArrayLike,
        yaw: float,
        rgba: Sequence[float],
    ) -> None:
        """Add a box, or a cylinder of radius `size[0]` and height `size[2]`, on the ground.

        It extends `_FOUNDATION_DEPTH_M` into the ground.
        """
        along, across, up = np.asarray(size, float)
        ground = float(self.height(*position))
        half = [along, 0.5 * (up + _FOUNDATION_DEPTH_M), 0.0]
        if kind == _BOX:
            half = [0.5 * along, 0.5 * across, 0.5 * (up + _FOUNDATION_DEPTH_M)]
        middle = [*position, ground + 0.5 * (up - _FOUNDATION_DEPTH_M)]
        self._add_geom(spec, name, type=kind, pos=middle, size=half, quat=_quaternion_about_z(yaw), rgba=rgba)

    @staticmethod
    def _add_geom(spec: mujoco.MjSpec, name: str, **geom: Any) -> None:
        """Add a geom that collides with the robot: its geoms collide with contype 1 only."""
        given = {key: value for key, value in geom.items() if value is not None}
        spec.worldbody.add_geom(
            **{
                "name": name,
                "contype": 1,
                "conaffinity": 0,
                "group": LASER_VISIBLE_GROUP,
                "solref": _SOLREF,
                **given,
            }
        )


def _parse_world(document: object, name: str) -> World:
    """Return the world of a YAML document."""
    fields = dict(_require_mapping(document, "the file"))
    schema = fields.pop("schema", None)
    if schema != SCHEMA or isinstance(schema, bool):
        raise ValueError(f"schema: found {schema!r}, expected {SCHEMA}")
    for kind, record in _PARTS.items():
        if kind in fields:
            rows = fields[kind]
            if not isinstance(rows, list):
                raise ValueError(f"{kind}: found {rows!r}, expected a list")
            fields[kind] = tuple(_make_record(record, row, f"{kind}[{i}]") for i, row in enumerate(rows))
    if "laser" in fields:
        fields["laser"] = _make_record(Laser, fields["laser"], "laser")
    return _make_record(World, {"name": name, **fields}, "the file")


def _make_record(record: type, fields: object, where: str) -> Any:
    """Return a record from a mapping; errors name the place in the file."""
    given = _require_mapping(fields, where)
    known = {field.name: field for field in attrs.fields(record)}
    for key in given:
        if key not in known:
            raise ValueError(f"{where}: found the field {key!r}, expected one of {', '.join(known)}")
    for key, field in known.items():
        if field.default is attrs.NOTHING and key not in given:
            raise ValueError(f"{where}: found no field {key!r}, expected one")
    try:
        return record(**given)
    except TypeError as error:  # text instead of a number
        raise ValueError(f"{where}: {error}") from None
    except ValueError as error:
        raise ValueError(f"{where}: {error}" if record is not World else str(error)) from None


def _require_mapping(value: object, where: str) -> Mapping[str, Any]:
    """Return the value if it is a mapping, else raise ValueError."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{where}: found {value!r}, expected fields with their values")
    return value


def _rotation(yaw: float) -> Array:
    """Return the 2-D rotation matrix of an angle in rad."""
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def _quaternion_about_z(yaw: float) -> list[float]:
    """Return the quaternion (w, x, y, z) of a yaw angle in rad."""
    return [float(np.cos(0.5 * yaw)), 0.0, 0.0, float(np.sin(0.5 * yaw))]
