"""A world around the robot: ground, walls, trees, tables, persons and the robot's laser, from a YAML file.

The robot starts at the origin, on level ground, looking along x. What a world does while time passes is the matter of
`persons` and `simulator`; here stands what it is, and how its geoms come into a model.
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
from numpy.typing import ArrayLike, NDArray

from quadvel_description.bounded_yaml import read_yaml
from quadvel_sim.checks import number, numbers, one_of, or_none, points, truth_value, whole_number
from quadvel_sim.laser import SEEN, Laser
from quadvel_sim.terrain import GEOM_NAME, perlin

Array = NDArray[np.float64]

SCHEMA = 1
FOLDER = Path(__file__).parent / "worlds"
SHIPPED = ("corridor", "park", "campus")
LOW = 0
"""Group of what lies so low that a laser need not see it"""
MOST_SOLIDS = 2_000
"""Boxes, cylinders and meshes of a world; more make the simulation of contacts and rays too slow"""
MOST_PERSONS = 50
MOST_HEIGHTS = 4_000_000
"""Points of the bumps of all patches: 100 m x 100 m"""
SURFACE_PRIORITY = 2
"""Of geoms of grass, gravel and hills, above the feet's 1: the surface tells the friction"""
STEEPEST = 15.0  # deg
_DEEP = 0.3  # m, by which what stands on the ground goes into it
_STEP = 0.05  # m between the points of a patch's heights
_RIM = 0.005  # m, of a patch above the ground around it
_LEG_RADIUS, _BOARD = 0.025, 0.03  # m, of tables
_ARC = 8  # points of a turn
_SOLREF = (0.01, 1.0)  # of all contacts, as the robot's own
_BOX, _CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
_COLOURS = {
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
    """What one walks on: friction of a foot on it; height of its bumps and their distance, m."""

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
    """A wall from point to point."""

    points: Array = attrs.field(**points(2))
    height: float = attrs.field(default=2.5, **number(0.05, 50.0))
    thickness: float = attrs.field(default=0.1, **number(0.01, 5.0))

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """One box a piece; they meet at the corners."""
        for k, (begin, end) in enumerate(itertools.pairwise(self.points)):
            centre, side = 0.5 * (begin + end), end - begin
            size = [float(np.hypot(*side)) + self.thickness, self.thickness, self.height]
            part = f"{name}_{k}" if len(self.points) > 2 else name
            yaw = float(np.arctan2(side[1], side[0]))
            world._upright(spec, part, _BOX, centre, size, yaw, _COLOURS["wall"])


@attrs.frozen(eq=False, kw_only=True)
class Box:
    """A box that stands on the ground: a bench, a kiosk, a parked car."""

    position: Array = attrs.field(**numbers(2))
    size: Array = attrs.field(**numbers(3, low=0.01))
    """Along, across and up, m."""
    yaw: float = attrs.field(default=0.0, **number(-360.0, 360.0))
    """deg"""

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """One geom."""
        yaw = np.radians(self.yaw)
        world._upright(spec, name, _BOX, self.position, self.size, yaw, _COLOURS["box"])


@attrs.frozen(eq=False, kw_only=True)
class Trees:
    """Trunks of trees, or posts, of one size."""

    positions: Array = attrs.field(**points(1))
    radius: float = attrs.field(default=0.15, **number(0.01, 3.0))
    height: float = attrs.field(default=3.0, **number(0.05, 50.0))

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """One cylinder each."""
        size = [self.radius, self.radius, self.height]
        for k, position in enumerate(self.positions):
            world._upright(spec, f"{name}_{k}", _CYLINDER, position, size, 0.0, _COLOURS["tree"])


@attrs.frozen(eq=False, kw_only=True)
class Table:
    """A board on four legs."""

    position: Array = attrs.field(**numbers(2))
    size: Array = attrs.field(default=(1.4, 0.7), **numbers(2, low=0.1))
    """Along and across, m."""
    height: float = attrs.field(default=0.74, **number(0.1, 3.0))
    yaw: float = attrs.field(default=0.0, **number(-360.0, 360.0))
    """deg"""

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """Four cylinders and a box."""
        yaw = np.radians(self.yaw)
        for k, corner in enumerate(self.legs):
            size = [_LEG_RADIUS, _LEG_RADIUS, self.height - _BOARD]
            world._upright(spec, f"{name}_leg_{k}", _CYLINDER, corner, size, yaw, _COLOURS["table"])
        below = float(world.height(*self.position)) + self.height - _BOARD
        world._add(
            spec,
            name,
            type=_BOX,
            pos=[*self.position, below + 0.5 * _BOARD],
            size=[0.5 * self.size[0], 0.5 * self.size[1], 0.5 * _BOARD],
            quat=_about_z(yaw),
            rgba=_COLOURS["table"],
        )

    @property
    def legs(self) -> Array:
        """Where they stand, (4, 2), m."""
        inwards = 0.5 * self.size - 2.0 * _LEG_RADIUS
        corners = inwards * [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]
        return np.asarray(self.position + corners @ _rotation(np.radians(self.yaw)).T)


@attrs.frozen(eq=False, kw_only=True)
class Patch:
    """A rectangle of another ground on the level: grass or gravel, with bumps. Lasers look over them."""

    surface: str = attrs.field(**one_of(["grass", "gravel"]))
    position: Array = attrs.field(**numbers(2))
    """Of its middle, m."""
    size: Array = attrs.field(**numbers(2, low=0.5))
    """Along and across, m."""
    yaw: float = attrs.field(default=0.0, **number(-360.0, 360.0))
    """deg"""
    friction: float | None = attrs.field(default=None, **or_none(number(0.05, 3.0)))
    """Of a foot on it; where nothing is said, the surface's."""
    bumps: float | None = attrs.field(default=None, **or_none(number(0.006, 0.2)))
    """Height of its bumps, m; where nothing is said, the surface's."""

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """A height field."""
        heights = self._heights(world.seed + 1 + world.patches.index(self))
        top = float(heights.max())
        spec.add_hfield(
            name=name,
            size=[0.5 * self.size[0], 0.5 * self.size[1], top, _DEEP],
            nrow=heights.shape[0],
            ncol=heights.shape[1],
            userdata=(heights / top).ravel(),
        )
        friction = SURFACES[self.surface].friction if self.friction is None else self.friction
        world._add(
            spec,
            name,
            type=mujoco.mjtGeom.mjGEOM_HFIELD,
            hfieldname=name,
            pos=[*self.position, 0.0],
            quat=_about_z(np.radians(self.yaw)),
            friction=[friction, 0.02, 0.01],
            priority=SURFACE_PRIORITY,
            group=LOW,
            rgba=_COLOURS[self.surface],
        )

    @property
    def count(self) -> float:
        """Number of points of its bumps."""
        return float(np.prod(self.size / _STEP + 1.0))

    def _heights(self, seed: int) -> Array:
        """From a rim to the bumps, rows across, columns along, m."""
        surface = SURFACES[self.surface]
        bumps = surface.bumps if self.bumps is None else self.bumps
        along, across = (np.linspace(0.0, length, round(length / _STEP) + 1) for length in self.size)
        x, y = np.meshgrid(along, across)
        inside = np.minimum(np.minimum(x, self.size[0] - x), np.minimum(y, self.size[1] - y))
        grown = np.clip(inside / surface.wavelength, 0.0, 1.0)
        noise = 0.5 * (1.0 + perlin(x, y, surface.wavelength, seed))
        return np.asarray(_RIM + grown * (bumps - _RIM) * noise)


@attrs.frozen(eq=False, kw_only=True)
class Hill:
    """A rectangular mound with a level top: up it, over it and down again; slopes on all four sides."""

    position: Array = attrs.field(**numbers(2))
    """Of its middle, m."""
    size: Array = attrs.field(**numbers(2, low=1.0))
    """Of its foot, along and across, m."""
    height: float = attrs.field(**number(0.02, 20.0))
    slope: float = attrs.field(**number(1.0, STEEPEST))
    """Up it and down again along its length, deg."""
    sides: float | None = attrs.field(default=None, **or_none(number(1.0, 60.0)))
    """Slopes across it, deg; where nothing is said, the same."""
    yaw: float = attrs.field(default=0.0, **number(-360.0, 360.0))
    """deg"""
    surface: str = attrs.field(default="paved", **one_of(list(SURFACES)))

    def __attrs_post_init__(self) -> None:
        highest = 0.98 * float((0.5 * self.size * self.steepness).min())
        if self.height > highest:
            raise ValueError(
                f"Hill.height: found {self.height:g}, expected at most {highest:.3g}, as slopes of its size meet above that"
            )

    @property
    def steepness(self) -> Array:
        """Rise a metre along it and across it, (2,)."""
        return np.tan(np.radians([self.slope, self.slope if self.sides is None else self.sides]))

    @property
    def top(self) -> Array:
        """Along and across, of its level top, (2,), m."""
        return np.asarray(self.size - 2.0 * self.height / self.steepness)

    def add_to(self, spec: mujoco.MjSpec, name: str, world: World) -> None:
        """A convex mesh of the corners of foot and top."""
        foot = 0.5 * self.size * [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]
        top = 0.5 * self.top * np.sign(foot)
        corners = np.vstack(
            [np.column_stack([foot, np.zeros(4)]), np.column_stack([top, np.full(4, self.height)])]
        )
        turn = np.eye(3)
        turn[:2, :2] = _rotation(np.radians(self.yaw))
        below = np.column_stack([foot, np.full(4, -_DEEP)])
        vertices = np.vstack([below, corners]) @ turn.T + [*self.position, 0.0]
        spec.add_mesh(name=name, uservert=vertices.ravel())
        world._add(
            spec,
            name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            friction=[SURFACES[self.surface].friction, 0.02, 0.01],
            priority=SURFACE_PRIORITY,
            rgba=_COLOURS[self.surface],
        )


@attrs.frozen(eq=False, kw_only=True)
class Person:
    """Somebody who walks; see `persons` for how."""

    way: Array = attrs.field(**points(2))
    """Points, m, from one to the next."""
    closed: bool = attrs.field(default=False, **truth_value())
    """Whether it goes on from the last point to the first, round after round; else it stays there."""
    led: bool = attrs.field(default=False, **truth_value())
    """Whether it is the one whom the robot is to follow."""
    speed: float = attrs.field(default=1.2, **number(0.1, 3.0))
    """m/s"""
    pace: float = attrs.field(default=0.0, **number(0.0, 0.9))
    """Share by which its speed rises and falls, slowly."""
    speeds: Sequence[Sequence[float]] = ()
    """[m along the way, m/s]: from there on it walks at that speed."""
    stops: Sequence[Sequence[float]] = ()
    """[m along the way, s]: there it stands for so long."""
    begins_at: float = attrs.field(default=0.0, **number(0.0))
    """m along the way, where it is at the start."""
    turn: float = attrs.field(default=0.8, **number(0.0, 20.0))
    """Radius of its turns at the points, m."""
    radius: float = attrs.field(default=0.06, **number(0.03, 0.15))
    """Of a leg, m."""
    apart: float = attrs.field(default=0.2, **number(0.1, 0.5))
    """Of the legs from each other, sideways, m."""

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
        """The way with its turns, (n, 2), m."""
        return rounded(self.way, self.turn, self.closed)


def rounded(way: Array, radius: float, closed: bool) -> Array:
    """`way` (n, 2) with arcs of about that radius, m, in place of its corners, at most half of each piece long."""
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
        if half < 0.05 or half > 0.5 * np.pi - 1e-3:  # it turns back, or goes on as it came
            found.append(here[None])
            continue
        cut = min(radius / np.tan(half), room)
        t = np.linspace(0.0, 1.0, _ARC)[:, None]
        found.append(
            here + cut * ((1.0 - t) ** 2 * back + t**2 * ahead)
        )  # a parabola, from tangent to tangent
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
    """What is around the robot, and its laser. ValueError where a part can't be."""

    name: str = "world"
    seed: int = attrs.field(default=0, **whole_number())
    """Of bumps and of the laser's faults."""
    laser: Laser = attrs.field(factory=Laser)
    walls: Sequence[Wall] = ()
    boxes: Sequence[Box] = ()
    trees: Sequence[Trees] = ()
    tables: Sequence[Table] = ()
    patches: Sequence[Patch] = ()
    hills: Sequence[Hill] = ()
    persons: Sequence[Person] = ()
    """The one who is led first."""

    def __attrs_post_init__(self) -> None:
        self._refuse_more("parts, pieces of walls and legs of tables counted each", self.solids, MOST_SOLIDS)
        self._refuse_more("persons", len(self.persons), MOST_PERSONS)
        self._refuse_more("points of bumps", sum(patch.count for patch in self.patches), MOST_HEIGHTS)
        led = [i for i, person in enumerate(self.persons) if person.led]
        if len(led) > 1 or led[1:] or (led and led[0] != 0):
            raise ValueError(f"persons: found {led} led, counted from 0, expected the first or none")
        if float(self.height(0.0, 0.0)) != 0.0:
            raise ValueError("hills: found one at the origin, expected level ground where the robot starts")

    @staticmethod
    def _refuse_more(what: str, found: float, most: int) -> None:
        if found > most:
            raise ValueError(f"found {found:.0f} {what}, expected {most} at most")

    @property
    def solids(self) -> int:
        """Number of geoms of what stands on the ground, and hills."""
        walls = sum(len(wall.points) - 1 for wall in self.walls)
        trees = sum(len(group.positions) for group in self.trees)
        return walls + len(self.boxes) + trees + 5 * len(self.tables) + len(self.hills)

    @classmethod
    def load(cls, source: str | Path) -> World:
        """Of a YAML file, or the shipped world of that name. ValueError names file, field, value found and what was expected."""
        path = FOLDER / f"{source}.yaml" if str(source) in SHIPPED else Path(source)
        try:
            document = read_yaml(path, "a YAML file of a world")
        except OSError as error:
            shipped = ", ".join(SHIPPED)
            raise ValueError(
                f"world {source}: {error.strerror}, expected a YAML file or one of {shipped}"
            ) from None
        try:
            return _world(document, path.stem)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height of the ground (m) at `x`, `y` (m, shapes that broadcast), the bumps of patches apart."""
        place = np.stack(np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float)), axis=-1)
        if not self.hills:
            return np.zeros(place.shape[:-1])
        centre, turn, half, steepness, top = self._hills
        away = ((place[..., None, :] - centre)[..., None, :] @ turn)[
            ..., 0, :
        ]  # (..., hills, 2), along and across each
        rise = ((half - np.abs(away)) * steepness).min(-1)
        return np.asarray(np.minimum(rise, top).max(-1).clip(0.0))

    @cached_property
    def _hills(self) -> tuple[Array, ...]:
        """Of all hills: centres, rotations, half sizes, steepnesses, heights."""
        return (
            np.array([hill.position for hill in self.hills]),
            np.array([_rotation(np.radians(hill.yaw)) for hill in self.hills]),
            np.array([0.5 * hill.size for hill in self.hills]),
            np.array([hill.steepness for hill in self.hills]),
            np.array([hill.height for hill in self.hills]),
        )

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add all that stands still to the robot's `spec`, as geoms of the world body that are named after their parts."""
        self._add(
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

    def _upright(
        self,
        spec: mujoco.MjSpec,
        name: str,
        kind: int,
        position: Array,
        size: ArrayLike,
        yaw: float,
        rgba: Sequence[float],
    ) -> None:
        """A box of that size, or a cylinder of twice that radius, from the ground up, and somewhat into it."""
        along, across, up = np.asarray(size, float)
        ground = float(self.height(*position))
        half = [along, 0.5 * (up + _DEEP), 0.0]
        if kind == _BOX:
            half = [0.5 * along, 0.5 * across, 0.5 * (up + _DEEP)]
        middle = [*position, ground + 0.5 * (up - _DEEP)]
        self._add(spec, name, type=kind, pos=middle, size=half, quat=_about_z(yaw), rgba=rgba)

    @staticmethod
    def _add(spec: mujoco.MjSpec, name: str, **geom: Any) -> None:
        """A geom that the robot's collide with; they do with contype 1 alone."""
        given = {key: value for key, value in geom.items() if value is not None}
        spec.worldbody.add_geom(
            **{"name": name, "contype": 1, "conaffinity": 0, "group": SEEN, "solref": _SOLREF, **given}
        )


def _world(document: object, name: str) -> World:
    fields = dict(_mapping(document, "the file"))
    schema = fields.pop("schema", None)
    if schema != SCHEMA or isinstance(schema, bool):
        raise ValueError(f"schema: found {schema!r}, expected {SCHEMA}")
    for kind, record in _PARTS.items():
        if kind in fields:
            rows = fields[kind]
            if not isinstance(rows, list):
                raise ValueError(f"{kind}: found {rows!r}, expected a list")
            fields[kind] = tuple(_made(record, row, f"{kind}[{i}]") for i, row in enumerate(rows))
    if "laser" in fields:
        fields["laser"] = _made(Laser, fields["laser"], "laser")
    return _made(World, {"name": name, **fields}, "the file")


def _made(record: type, fields: object, where: str) -> Any:
    """A record of a mapping; errors say where in the file it stands."""
    given = _mapping(fields, where)
    known = {field.name: field for field in attrs.fields(record)}
    for key in given:
        if key not in known:
            raise ValueError(f"{where}: found the field {key!r}, expected one of {', '.join(known)}")
    for key, field in known.items():
        if field.default is attrs.NOTHING and key not in given:
            raise ValueError(f"{where}: found no field {key!r}, expected one")
    try:
        return record(**given)
    except TypeError as error:  # a word where a number should be
        raise ValueError(f"{where}: {error}") from None
    except ValueError as error:
        raise ValueError(f"{where}: {error}" if record is not World else str(error)) from None


def _mapping(value: object, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{where}: found {value!r}, expected fields with their values")
    return value


def _rotation(yaw: float) -> Array:
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def _about_z(yaw: float) -> list[float]:
    return [float(np.cos(0.5 * yaw)), 0.0, 0.0, float(np.sin(0.5 * yaw))]
