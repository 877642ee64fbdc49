"""A world in a running simulation: persons walk, the laser looks, and what the robot touches is counted."""

from __future__ import annotations

from collections import Counter

import mujoco
import numpy as np
from numpy.typing import NDArray

from quadvel_sim.laser import RayCaster, Scan
from quadvel_sim.persons import PERIOD, Persons, name_of
from quadvel_sim.terrain import GEOM_NAME
from quadvel_sim.world import World

APART = 500  # ms without a touch, after which the next one counts anew


class Surroundings:
    """What happens in `world`, whose geoms are in `model`. touched: how often the robot touched what stands or walks there."""

    def __init__(self, model: mujoco.MjModel, world: World) -> None:
        self.persons = Persons(model, world)
        self.touched: Counter[str] = Counter()
        self._caster, self._period, self._seed = RayCaster(model, world.laser), world.laser.period, world.seed
        robot = model.body("trunk").id
        self._names = {
            geom: _named(model.geom(geom).name)
            for geom in range(model.ngeom)
            if model.geom_contype[geom] and model.body_rootid[model.geom_bodyid[geom]] != robot
        }
        self._obstacle = np.zeros(model.ngeom, dtype=bool)
        self._obstacle[[geom for geom, name in self._names.items() if not is_ground(name)]] = True

    def reset(self, data: mujoco.MjData, seed: int) -> None:
        """Back to the start; `seed` of the robot's noise goes into the laser's, too."""
        self.persons.reset(data)
        self.touched.clear()
        self._steps, self._scans, self._seeds = 0, 0, [seed, self._seed]
        self._last: dict[str, int] = {}

    def step(self, data: mujoco.MjData) -> None:
        """A millisecond has passed in `data`."""
        self._steps += 1
        if data.ncon:
            self._look_at_contacts(data.contact.geom)
        if self._steps % PERIOD == 0:
            self.persons.step(data)

    def scan(self, data: mujoco.MjData) -> Scan | None:
        """The scan of this instant, or None if none is due since the last one. `data` is of this instant."""
        due = self._steps // self._period + 1
        if due == self._scans:
            return None
        self._scans = due
        scanner = self._caster.scanner
        ranges = scanner.read(self._caster.distances(data), np.random.default_rng([*self._seeds, due]))
        return Scan(1e-3 * self._steps, ranges, scanner.angle_min, scanner.angle_increment)

    def _look_at_contacts(self, geoms: NDArray[np.int32]) -> None:
        if not self._obstacle[geoms].any():
            return
        for name in {self._names[geom] for geom in geoms[self._obstacle[geoms]].tolist()}:
            if self._steps - self._last.get(name, -APART) >= APART:
                self.touched[name] += 1
            self._last[name] = self._steps


def is_ground(name: str) -> bool:
    """Whether the geom of that name is to walk on."""
    return name == GEOM_NAME or name.startswith(("patch_", "hill_"))


def _named(geom: str) -> str:
    """As it is told: a person as a whole, all else by its geom."""
    parts = geom.split("_")
    return name_of(int(parts[1])) if parts[0] == "person" else geom
