"""Simulates scenes that are hard for person trackers: crossing, occlusion, walking along walls.

`quadvel_sim.walker` moves the people, `laser` computes the scans, and `measure` runs the trackers
and scores them. Positions are in the world frame: m, x and y in the plane; yaw in rad from x to y.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_sim.walker import Walker, leg_circles

from .laser import FloorPlan, Laser

WALKING_STEP_S = 0.005  # simulation step of the people; divides the periods of SCAN_RATES_HZ
RESOLUTIONS = np.deg2rad([0.25, 0.36, 0.5, 1.0])  # rad between two rays
SCAN_RATES_HZ = (10.0, 20.0, 40.0)
HIDDEN_S = 1.5  # for which the person of `occlusion` is behind the tree


@attrs.frozen
class SceneScan:
    """One scan of a scene.

    Attributes:
        time: Time since the start of the scene, s.
        ranges: Ranges, (rays,), m; `Laser.no_return` (0, NaN or inf) where there is no echo.
        pose: x, y (m) and yaw (rad) of the scanner in the world frame.
        people: True positions of the people in the world frame, (people, 2), m.
    """

    time: float
    ranges: Array
    pose: Array
    people: Array


@attrs.frozen
class Scene:
    """People who walk on a floor plan, and a scanner that sees them.

    Attributes:
        laser: The scanner.
        rate: Scan rate, Hz.
        plan: Static obstacles.
        walkers: The people.
        duration: Duration, s.
        rng: Random number generator of the noise.
        pose: Function from the people's positions, (people, 2), m, to the scanner's pose: x, y in
            m, yaw in rad. The default is a scanner that rests at the origin.
    """

    laser: Laser
    rate: float
    plan: FloorPlan
    walkers: list[Walker]
    duration: float
    rng: np.random.Generator
    pose: Callable[[Array], Array] = lambda people: np.zeros(3)

    def scans(self) -> Iterator[SceneScan]:
        """Simulate the scene.

        Yields:
            The scans in order.
        """
        steps = round(1.0 / self.rate / WALKING_STEP_S)
        for k in range(int(self.duration * self.rate)):
            people = np.array([walker.position for walker in self.walkers])
            pose = self.pose(people)
            ranges = self.laser.scan(self.plan.with_circles(leg_circles(self.walkers)), pose, self.rng)
            yield SceneScan(k * steps * WALKING_STEP_S, ranges, pose, people)
            for walker in self.walkers:
                for _ in range(steps):
                    walker.step(WALKING_STEP_S)


def crossing(seed: int) -> Scene:
    """Create two people whose paths cross at a random angle, and who pass within half a metre.

    Args:
        seed: Seed of the scene.

    Returns:
        The scene.
    """
    rng = np.random.default_rng([1, seed])
    meeting = np.array([rng.uniform(2.0, 4.5), rng.uniform(-1.0, 1.0)])
    first, angle = rng.uniform(-np.pi, np.pi), rng.uniform(np.deg2rad(40.0), np.pi) * rng.choice([-1.0, 1.0])
    walkers = []
    for direction, aside in ((first, 0.2), (first + angle, 0.2)):
        ahead = np.array([np.cos(direction), np.sin(direction)])
        path_centre = meeting + aside * np.array([ahead[1], -ahead[0]])
        speed = rng.uniform(0.8, 1.5)
        way = [path_centre - 3.0 * speed * ahead, path_centre + 3.0 * speed * ahead]
        walkers.append(_walker(rng, way, speed))
    return Scene(_laser(rng), rng.choice(SCAN_RATES_HZ), _trees(rng, meeting), walkers, 6.0, rng)


def occlusion(seed: int) -> Scene:
    """Create a person who is hidden behind a tree for HIDDEN_S.

    Args:
        seed: Seed of the scene.

    Returns:
        The scene.
    """
    rng = np.random.default_rng([2, seed])
    distance, speed = rng.uniform(2.5, 5.0), rng.uniform(0.8, 1.4)
    to_tree = distance * rng.uniform(0.4, 0.6)
    # The shadow of the tree at the walker's distance has width 2 r distance / to_tree; the walker
    # crosses it in HIDDEN_S.
    radius = 0.5 * HIDDEN_S * speed * to_tree / distance
    side = rng.choice([-1.0, 1.0])
    way = np.array([[distance, -3.0 * side * speed], [distance, 4.0 * side * speed]])
    turn = rng.uniform(-np.pi, np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    tree = rotation @ [to_tree, 0.0]
    plan = _trees(rng, rotation @ [distance, 0.0]).with_circles([[*tree, radius]])
    return Scene(
        _laser(rng), rng.choice(SCAN_RATES_HZ), plan, [_walker(rng, way @ rotation.T, speed)], 6.0, rng
    )


def along_walls(seed: int) -> Scene:
    """Create a person who walks 20 m through a corridor with doors and tables, with one stop.

    The scanner follows 1.5 m behind.

    Args:
        seed: Seed of the scene.

    Returns:
        The scene.
    """
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
        rng.choice(SCAN_RATES_HZ),
        FloorPlan(posts, segments),
        [walker],
        20.0 / speed + 2.0,
        rng,
        lambda people: np.array([people[0, 0] - 1.5, 0.0, 0.1 * np.sin(people[0, 0])]),
    )


SCENES: Mapping[str, Callable[[int], Scene]] = {
    "two people crossing": crossing,
    "1.5 s behind a tree": occlusion,
    "20 m along walls": along_walls,
}


def _walker(rng: np.random.Generator, way: ArrayLike, speed: float) -> Walker:
    """Create a walker with random legs and gait. Way: (n, 2), m; speed: m/s."""
    return Walker(
        way=way,
        speed=speed,
        pace=rng.uniform(0.0, 0.1),
        radius=rng.uniform(0.05, 0.08),
        apart=rng.uniform(0.16, 0.28),
        phase=rng.random(),
    )


def _laser(rng: np.random.Generator) -> Laser:
    """Create a scanner with random resolution, range and noise."""
    resolution = rng.choice(RESOLUTIONS)
    return Laser(
        rays=round(2.0 * np.pi / resolution),
        angle_increment=resolution,
        noise=rng.uniform(0.005, 0.02),
        range_max=rng.choice([12.0, 30.0]),
        no_return=rng.choice([0.0, np.nan, np.inf]),
    )


def _trees(rng: np.random.Generator, free: Array) -> FloorPlan:
    """Create two walls, and trees farther than 2 m from `free` and 1 m from the origin."""
    trees = [(*rng.uniform(-7.0, 7.0, 2), rng.uniform(0.1, 0.3)) for _ in range(6)]
    kept = [tree for tree in trees if np.hypot(*(tree[:2] - free)) > 2.0 and np.hypot(*tree[:2]) > 1.0]
    return FloorPlan(kept, [[-8.0, 7.5, 8.0, 7.5], [-8.0, -7.5, 8.0, -7.5]])
