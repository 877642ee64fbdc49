"""Dynamics of a world in a simulation: walking people, laser scans and touch counts.

`world_parts` builds the geoms, `persons` moves the people, `laser` casts the rays, and `world_view`
publishes the results. It acts on the model of the `Simulator` that owns it.
"""

from __future__ import annotations

from collections import Counter

import mujoco
import numpy as np
from numpy.typing import NDArray

from quadvel_sim.laser import RayCaster, Scan
from quadvel_sim.persons import UPDATE_PERIOD_MS, Persons, person_name
from quadvel_sim.terrain import GEOM_NAME
from quadvel_sim.world import World

TOUCH_GAP_MS = 500
"""Time without contact after which the next contact counts as another touch."""


class Surroundings:
    """People, laser and touch counts of a world whose geoms are in a model.

    Attributes:
        persons: The walking people.
        touch_counts: Number of touches between robot and objects or people, by name.
    """

    def __init__(self, model: mujoco.MjModel, world: World) -> None:
        """Find the world's geoms in the model.

        Args:
            model: Compiled robot and world.
            world: The world.
        """
        self.persons = Persons(model, world)
        self.touch_counts: Counter[str] = Counter()
        self._caster, self._period, self._seed = RayCaster(model, world.laser), world.laser.period, world.seed
        robot = model.body("trunk").id
        self._names = {
            geom: _object_name(model.geom(geom).name)
            for geom in range(model.ngeom)
            if model.geom_contype[geom] and model.body_rootid[model.geom_bodyid[geom]] != robot
        }
        self._is_obstacle = np.zeros(model.ngeom, dtype=bool)
        self._is_obstacle[[geom for geom, name in self._names.items() if not is_ground(name)]] = True

    def reset(self, data: mujoco.MjData, seed: int) -> None:
        """Go back to the start.

        Args:
            data: State of the model.
            seed: Seed of the robot's noise; the laser's errors depend on it, too.
        """
        self.persons.reset(data)
        self.touch_counts.clear()
        self._steps, self._scans, self._seeds = 0, 0, [seed, self._seed]
        self._last_touch: dict[str, int] = {}

    def step(self, data: mujoco.MjData) -> None:
        """Update touches and people after each millisecond of the simulation.

        Args:
            data: State of the model.
        """
        self._steps += 1
        if data.ncon:
            self._count_touches(data.contact.geom)
        if self._steps % UPDATE_PERIOD_MS == 0:
            self.persons.step(data)

    def scan(self, data: mujoco.MjData) -> Scan | None:
        """Return the scan of this instant.

        Args:
            data: State of the model; derived quantities must be up to date.

        Returns:
            The scan; None if no scan is due since the last one.
        """
        due = self._steps // self._period + 1
        if due == self._scans:
            return None
        self._scans = due
        scanner = self._caster.scanner
        ranges = scanner.measure(self._caster.distances(data), np.random.default_rng([*self._seeds, due]))
        return Scan(1e-3 * self._steps, ranges, scanner.angle_min, scanner.angle_increment)

    def _count_touches(self, geoms: NDArray[np.int32]) -> None:
        """Count a touch of each obstacle that was not touched for `TOUCH_GAP_MS`."""
        if not self._is_obstacle[geoms].any():
            return
        for name in {self._names[geom] for geom in geoms[self._is_obstacle[geoms]].tolist()}:
            if self._steps - self._last_touch.get(name, -TOUCH_GAP_MS) >= TOUCH_GAP_MS:
                self.touch_counts[name] += 1
            self._last_touch[name] = self._steps


def is_ground(name: str) -> bool:
    """Return whether a geom is ground to walk on.

    Args:
        name: Name of the geom.

    Returns:
        True for ground, patches and hills.
    """
    return name == GEOM_NAME or name.startswith(("patch_", "hill_"))


def _object_name(geom: str) -> str:
    """Return the name for touch counts of a geom: the person it belongs to, else itself."""
    parts = geom.split("_")
    return person_name(int(parts[1])) if parts[0] == "person" else geom
