"""World around the robot from a YAML file: ground, walls, trees, tables, people, laser.

The robot starts at the origin on level ground and faces along x. `world_parts` holds the
parts of a world; `surroundings` and `persons` simulate what changes with time.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import attrs
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.fields import field
from quadvel_description.records import read_document, structure_record
from quadvel_sim.laser import Laser
from quadvel_sim.terrain import GEOM_NAME
from quadvel_sim.world_parts import Box, Hill, Patch, Person, Table, Trees, Wall, add_geom, planar_rotation

SCHEMA = 1
WORLDS_FOLDER = Path(__file__).parent / "worlds"
SHIPPED_WORLDS = ("corridor", "park", "campus")
MAX_SOLIDS = 2_000
"""Largest number of boxes, cylinders and meshes: more make contacts and rays too slow."""
MAX_PERSONS = 50
MAX_HEIGHT_POINTS = 4_000_000
"""Largest number of height points of all patches: 100 m x 100 m."""


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
        trees: Groups of trees.
        tables: Tables.
        patches: Patches of grass or gravel.
        hills: Hills.
        persons: People; the one that the robot must follow (`led`) is the first.
    """

    name: str = "world"
    seed: int = field(0, at_least=0, whole=True)
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
        if led not in ([], [0]):
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
            content = read_document(path, "a YAML file of a world", SCHEMA)
        except OSError as error:
            shipped = ", ".join(SHIPPED_WORLDS)
            raise ValueError(
                f"world {source}: {error.strerror}, expected a YAML file or one of {shipped}"
            ) from None
        return structure_record(cls, {"name": path.stem, **content}, path)

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
        # Along and across each hill, (..., hills, 2).
        away = np.einsum("...hi,hij->...hj", place[..., None, :] - centre, turn)
        rise = ((half - np.abs(away)) * steepness).min(-1)
        return np.asarray(np.minimum(rise, top).max(-1).clip(0.0))

    @cached_property
    def _hill_arrays(self) -> tuple[Array, ...]:
        """Centres, rotations, half sizes, slopes and heights of all hills."""
        return (
            np.array([hill.position for hill in self.hills]),
            np.array([planar_rotation(np.radians(hill.yaw)) for hill in self.hills]),
            np.array([0.5 * hill.size for hill in self.hills]),
            np.array([hill.steepness for hill in self.hills]),
            np.array([hill.height for hill in self.hills]),
        )

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add all static parts to a model, as geoms of the world body named after the parts.

        Args:
            spec: Model that is extended.
        """
        add_geom(spec, GEOM_NAME, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.1], material=GEOM_NAME)
        for i, wall in enumerate(self.walls):
            wall.add_to(spec, f"wall_{i}", self.height)
        for i, box in enumerate(self.boxes):
            box.add_to(spec, f"box_{i}", self.height)
        for i, trees in enumerate(self.trees):
            trees.add_to(spec, f"tree_{i}", self.height)
        for i, table in enumerate(self.tables):
            table.add_to(spec, f"table_{i}", self.height)
        for i, patch in enumerate(self.patches):
            patch.add_to(spec, f"patch_{i}", self.seed + 1 + i)
        for i, hill in enumerate(self.hills):
            hill.add_to(spec, f"hill_{i}")
