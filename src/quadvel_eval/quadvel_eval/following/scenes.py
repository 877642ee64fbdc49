"""Simulates scenes that are hard for a planner that follows a person, each from a seed.

`people.scenes` has the scenes for the tracker alone; `stage` simulates robot and people in a scene,
and `measure` scores the runs. Positions are in the world frame, m.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_sim.walker import Walker

from ..people.laser import FloorPlan
from ..people.scenes import along_walls

INITIAL_STOP = (
    1.6,
    6.0,
)  # s, start and end of the first stop of the person, in which the tracker confirms the track
INITIAL_STOP_DURATION_S = INITIAL_STOP[1] - INITIAL_STOP[0]


@attrs.frozen
class FollowScene:
    """Scene with a person to follow.

    Attributes:
        plan: Static obstacles.
        people: Walkers; the first is the person to follow.
        duration: Duration, s.
        initial_distance: Distance from the person to the robot behind, m.
    """

    plan: FloorPlan
    people: list[Walker]
    duration: float
    initial_distance: float = 1.5


def corridor(seed: int) -> FollowScene:
    """Create a corridor of 20 m with doors and tables, and a stop.

    Args:
        seed: Seed of the scene.

    Returns:
        The scene.
    """
    scene = along_walls(seed)
    person = scene.walkers[0]
    person.stops = [
        INITIAL_STOP,
        *((begin + INITIAL_STOP_DURATION_S, end + INITIAL_STOP_DURATION_S) for begin, end in person.stops),
    ]
    return FollowScene(scene.plan, [person], 20.0 / person.speed + 2.0 + INITIAL_STOP_DURATION_S + 5.0)


def trees(seed: int) -> FollowScene:
    """Create a slalom around trees, with a stop.

    Args:
        seed: Seed of the scene.

    Returns:
        The scene.
    """
    rng = np.random.default_rng([11, seed])
    places = [(2.5 * i, rng.uniform(-0.2, 0.2), rng.uniform(0.1, 0.25)) for i in range(1, 7)]
    sides = rng.choice([-1.0, 1.0]) * np.resize([1.0, -1.0], 6)
    way = [[-1.0, 0.0], *([x, y + 1.0 * s] for (x, y, _), s in zip(places, sides, strict=True)), [18.0, 0.0]]
    return FollowScene(FloorPlan(places), [_person(rng, way, (0.8, 1.3), [(11.0, 13.0)])], 36.0)


def turning_round(seed: int) -> FollowScene:
    """Create a person who turns round and passes close to the robot.

    Args:
        seed: Seed of the scene.

    Returns:
        The scene.
    """
    rng = np.random.default_rng([12, seed])
    aside = rng.choice([-1.0, 1.0]) * rng.uniform(0.0, 0.5)
    away = rng.uniform(5.0, 7.0)
    way = [[0.0, 0.0], [away, 0.0], [away, 0.2], [-4.0, aside]]
    posts = [[x, y, 0.15] for x in (-3.0, 1.0, 5.0) for y in (-3.0, 3.0)]
    return FollowScene(FloorPlan(posts), [_person(rng, way, (0.7, 1.1))], 34.0)


def crossing(seed: int) -> FollowScene:
    """Create bystanders who cross between the person and the robot.

    Args:
        seed: Seed of the scene.

    Returns:
        The scene.
    """
    rng = np.random.default_rng([13, seed])
    person = _person(rng, [[0.0, 0.0], [16.0, 0.0]], (0.9, 1.5))
    others = []
    for x in rng.uniform(3.0, 14.0, 3):
        side, speed = rng.choice([-1.0, 1.0]), rng.uniform(0.8, 1.3)
        # So far to the side that the bystander crosses the path 0.4 to 1.4 m behind the person.
        start_y = side * speed * ((x + rng.uniform(0.4, 1.4)) / person.speed + INITIAL_STOP_DURATION_S)
        way = [[x, start_y], [x + rng.uniform(-0.5, 0.5), start_y - side * 30.0]]
        others.append(_walker(rng, way, (speed, speed)))
    posts = [[x, y, 0.15] for x in (2.0, 8.0, 14.0) for y in (-3.0, 3.0)]
    return FollowScene(
        FloorPlan(posts), [person, *others], 16.0 / person.speed + INITIAL_STOP_DURATION_S + 5.0
    )


def narrow(seed: int) -> FollowScene:
    """Create a passage 1.0 m wide and 0.4 m deep, off the straight path.

    Args:
        seed: Seed of the scene.

    Returns:
        The scene.
    """
    rng = np.random.default_rng([14, seed])
    gap, x = rng.uniform(-1.5, 1.5), 5.0
    walls = []
    for low, high in ((-5.0, gap - 0.5), (gap + 0.5, 5.0)):
        walls += [
            [x, low, x, high],
            [x + 0.4, low, x + 0.4, high],
            [x, low, x + 0.4, low],
            [x, high, x + 0.4, high],
        ]
    way = [[0.0, 0.0], [x - 1.0, gap], [x + 1.4, gap], [x + 5.0, rng.uniform(-2.0, 2.0)]]
    return FollowScene(FloorPlan((), walls), [_person(rng, way, (0.7, 1.2))], 24.0)


def corner(seed: int) -> FollowScene:
    """Create a corridor with a corner that hides the person for some time.

    Args:
        seed: Seed of the scene.

    Returns:
        The scene.
    """
    rng = np.random.default_rng([15, seed])
    half, side = rng.uniform(0.8, 1.1), rng.choice([-1.0, 1.0])
    x = 6.0
    walls = [[-6.0, -half, x + half, -half], [-6.0, half, x - half, half], [x - half, half, x - half, 12.0],
             [x + half, -half, x + half, 12.0], [x - half, 12.0, x + half, 12.0], [-6.0, -half, -6.0, half]]  # fmt: skip
    turned = np.array(walls) * [1.0, side, 1.0, side]
    way = [[0.0, 0.0], [x, 0.0], [x, 9.0 * side]]
    return FollowScene(FloorPlan((), turned), [_person(rng, way, (1.1, 1.4))], 24.0)


def dead_end(seed: int) -> FollowScene:
    """Create a dead end, from which the person returns past the robot.

    Args:
        seed: Seed of the scene.

    Returns:
        The scene.
    """
    rng = np.random.default_rng([16, seed])
    half = rng.uniform(1.1, 1.4)
    walls = [[1.0, -half, 8.0, -half], [1.0, half, 8.0, half], [8.0, -half, 8.0, half]]
    aside = rng.choice([-1.0, 1.0]) * (half - 0.4)
    way = [[0.0, 0.0], [6.8, 0.0], [6.8, 0.5 * aside], [5.8, aside], [-4.0, aside]]
    return FollowScene(FloorPlan((), walls), [_person(rng, way, (0.7, 1.0), [(15.0, 17.0)])], 40.0)


def in_the_way(seed: int) -> FollowScene:
    """Create a bystander who steps out of a door behind the person and blocks the corridor for 6 s.

    Args:
        seed: Seed of the scene.

    Returns:
        The scene.
    """
    rng = np.random.default_rng([17, seed])
    half, x = rng.uniform(0.7, 0.85), 6.0
    walls = [[-4.0, -half, 20.0, -half], [-4.0, half, x - 0.6, half], [x + 0.6, half, 20.0, half]]
    person = _person(rng, [[0.0, 0.0], [10.0, 0.0]], (0.8, 1.1))
    comes = (x + 0.5) / person.speed + INITIAL_STOP_DURATION_S  # s, just after the person has passed
    speed = 1.2
    into = half + 1.0
    other = _walker(rng, [[x, into], [x, 0.0], [x, 3.0 * into]], (speed, speed))
    other.stops = [(0.0, comes), (comes + into / speed, comes + into / speed + 6.0)]
    return FollowScene(FloorPlan((), walls), [person, other], comes + 18.0)


SCENES: Mapping[str, Callable[[int], FollowScene]] = {
    "corridor with doors": corridor,
    "slalom of trees": trees,
    "turns round, walks at the robot": turning_round,
    "bystanders cross": crossing,
    "passage of 1.0 m": narrow,
    "round a corner, out of sight": corner,
    "dead end": dead_end,
    "a person stands in the way": in_the_way,
}


def _person(
    rng: np.random.Generator,
    way: ArrayLike,
    speeds: tuple[float, float],
    stops: list[tuple[float, float]] | None = None,
) -> Walker:
    """Create the person to follow, with an initial stop."""
    return _walker(rng, way, speeds, [INITIAL_STOP, *(stops or ())])


def _walker(
    rng: np.random.Generator,
    way: ArrayLike,
    speeds: tuple[float, float],
    stops: list[tuple[float, float]] | None = None,
) -> Walker:
    """Create a walker with a random speed and gait."""
    return Walker(
        way=way,
        speed=rng.uniform(*speeds),
        stops=stops or [],
        pace=rng.uniform(0.0, 0.1),
        apart=rng.uniform(0.16, 0.28),
        phase=rng.random(),
    )
