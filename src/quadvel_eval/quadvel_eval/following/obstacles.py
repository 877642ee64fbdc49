"""What stands in a world, as points in the plane from which clearances are told."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_sim.world import World

Array = NDArray[np.float64]

APART = 0.03  # m, between two points of an outline


def outlines(world: World) -> Array:
    """Points (n, 2), m, APART from each other, around walls, boxes, trees and the legs of tables."""
    found = [
        _rectangle(
            0.5 * (a + b), (np.hypot(*(b - a)) + wall.thickness, wall.thickness), np.arctan2(*(b - a)[::-1])
        )
        for wall in world.walls
        for a, b in pairwise(wall.points)
    ]
    found += [_rectangle(box.position, box.size[:2], np.radians(box.yaw)) for box in world.boxes]
    found += [_circle(place, trees.radius) for trees in world.trees for place in trees.positions]
    found += [table.legs for table in world.tables]
    return np.concatenate(found) if found else np.zeros((0, 2))


def _circle(middle: Array, radius: float) -> Array:
    angle = np.linspace(0.0, 2.0 * np.pi, 4 + int(2.0 * np.pi * radius / APART), endpoint=False)
    return middle + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _rectangle(middle: ArrayLike, size: ArrayLike, yaw: float) -> Array:
    """Points on the edge of a rectangle of `size` (2,) m, turned by `yaw` rad."""
    half = 0.5 * np.asarray(size, float)
    corners = half * [[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]
    edges = [
        a + np.linspace(0.0, 1.0, 2 + int(np.hypot(*(b - a)) / APART))[:, None] * (b - a)
        for a, b in pairwise(corners)
    ]
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(middle, float) + np.concatenate(edges) @ np.array([[c, s], [-s, c]])
