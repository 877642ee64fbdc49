"""Simulated scenes in which trackers go wrong, each from a seed: people crossing, a person behind a tree, a way along walls."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_sim.walker import Walker, leg_circles

from .laser import FloorPlan, Laser

Array = NDArray[np.float64]

STEP = 0.01  # s, in which persons walk
RESOLUTIONS = np.deg2rad([0.25, 0.36, 0.5, 1.0])
RATES = (10.0, 20.0, 40.0)  # Hz


@attrs.frozen
class Instant:
    """One scan: time in s, ranges (rays,) in m, the sensor's pose x, y, yaw, and where the persons are, (persons, 2), m."""

    time: float
    ranges: Array
    pose: Array
    persons: Array


@attrs.frozen
class Scene:
    """Persons on a floor plan, seen by a scanner of so many scans a second, whose pose is a function of the persons' positions."""

    laser: Laser
    rate: float
    plan: FloorPlan
    walkers: list[Walker]
    duration: float
    rng: np.random.Generator
    pose: Callable[[Array], Array] = lambda persons: np.zeros(3)

    def instants(self) -> Iterator[Instant]:
        """The scans, in order."""
        steps = round(1.0 / self.rate / STEP)
        for k in range(int(self.duration * self.rate)):
            persons = np.array([walker.position for walker in self.walkers])
            pose = self.pose(persons)
            ranges = self.laser.scan(self.plan.with_circles(leg_circles(self.walkers)), pose, self.rng)
            yield Instant(k * steps * STEP, ranges, pose, persons)
            for walker in self.walkers:
                for _ in range(steps):
                    walker.step(STEP)


def crossing(seed: int) -> Scene:
    """Two persons whose ways cross at any angle; they meet there, and pass within half a metre of each other."""
    rng = np.random.default_rng([1, seed])
    meeting = np.array([rng.uniform(2.0, 4.5), rng.uniform(-1.0, 1.0)])
    first, angle = rng.uniform(-np.pi, np.pi), rng.uniform(np.deg2rad(40.0), np.pi) * rng.choice([-1.0, 1.0])
    walkers = []
    for direction, aside in ((first, 0.2), (first + angle, 0.2)):
        ahead = np.array([np.cos(direction), np.sin(direction)])
        beside = meeting + aside * np.array([ahead[1], -ahead[0]])
        speed = rng.uniform(0.8, 1.5)
        way = [beside - 3.0 * speed * ahead, beside + 3.0 * speed * ahead]
        walkers.append(_walker(rng, way, speed))
    return Scene(_laser(rng), rng.choice(RATES), _trees(rng, meeting), walkers, 6.0, rng)


def occlusion(seed: int) -> Scene:
    """A person who passes behind a tree, out of sight for 1.5 s."""
    rng = np.random.default_rng([2, seed])
    distance, speed, hidden = rng.uniform(2.5, 5.0), rng.uniform(0.8, 1.4), 1.5
    to_tree = distance * rng.uniform(0.4, 0.6)
    radius = 0.5 * hidden * speed * to_tree / distance
    side = rng.choice([-1.0, 1.0])
    way = np.array([[distance, -3.0 * side * speed], [distance, 4.0 * side * speed]])
    turn = rng.uniform(-np.pi, np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    tree = rotation @ [to_tree, 0.0]
    plan = _trees(rng, rotation @ [distance, 0.0]).with_circles([[*tree, radius]])
    return Scene(_laser(rng), rng.choice(RATES), plan, [_walker(rng, way @ rotation.T, speed)], 6.0, rng)


def along_walls(seed: int) -> Scene:
    """A person 20 m down a corridor with doors and tables, the scanner 1.5 m behind; stops and goes on, on the way."""
    rng = np.random.default_rng([3, seed])
    half, aside, speed = rng.uniform(0.8, 1.6), rng.uniform(-0.3, 0.3), rng.uniform(0.8, 1.4)
    segments: list[list[float]] = []
    posts: list[tuple[float, float, float]] = []
    for wall in (-half, half):
        x = -5.0
        while x < 30.0:
            length, door = rng.uniform(1.0, 4.0), rng.uniform(0.7, 1.1)
            inwards = 0.05 * -np.sign(wall)
            segments += [[x, wall, x + length, wall]]
            segments += [[end, wall, end, wall + inwards] for end in (x, x + length)]
            x += length + door
        for x in rng.uniform(0.0, 25.0, 3):  # tables against the wall
            depth, outer = 0.3, wall - 0.1 * np.sign(wall)
            posts += [(x + i, outer - j * np.sign(wall), 0.025) for i in (0.0, 1.0) for j in (0.0, depth)]
    segments += [[-5.0, -2 * half, -5.0, 2 * half], [30.0, -2 * half, 30.0, 2 * half]]
    stop = rng.uniform(4.0, 10.0)
    walker = _walker(rng, [[1.5, aside], [21.5, -aside]], speed)
    walker.stops = [(stop, stop + 2.0)]
    return Scene(
        _laser(rng),
        rng.choice(RATES),
        FloorPlan(posts, segments),
        [walker],
        20.0 / speed + 2.0,
        rng,
        lambda persons: np.array([persons[0, 0] - 1.5, 0.0, 0.1 * np.sin(persons[0, 0])]),
    )


SCENES: Mapping[str, Callable[[int], Scene]] = {
    "two people crossing": crossing,
    "1.5 s behind a tree": occlusion,
    "20 m along walls": along_walls,
}


def _walker(rng: np.random.Generator, way: ArrayLike, speed: float) -> Walker:
    return Walker(
        way=way,
        speed=speed,
        pace=rng.uniform(0.0, 0.1),
        radius=rng.uniform(0.05, 0.08),
        apart=rng.uniform(0.16, 0.28),
        phase=rng.random(),
    )


def _laser(rng: np.random.Generator) -> Laser:
    resolution = rng.choice(RESOLUTIONS)
    return Laser(
        rays=round(2.0 * np.pi / resolution),
        angle_increment=resolution,
        noise=rng.uniform(0.005, 0.02),
        range_max=rng.choice([12.0, 30.0]),
        no_return=rng.choice([0.0, np.nan, np.inf]),
    )


def _trees(rng: np.random.Generator, free: Array) -> FloorPlan:
    """Some trees and a wall, not within 2 m of `free`."""
    trees = [(*rng.uniform(-7.0, 7.0, 2), rng.uniform(0.1, 0.3)) for _ in range(6)]
    kept = [tree for tree in trees if np.hypot(*(tree[:2] - free)) > 2.0 and np.hypot(*tree[:2]) > 1.0]
    return FloorPlan(kept, [[-8.0, 7.5, 8.0, 7.5], [-8.0, -7.5, 8.0, -7.5]])
