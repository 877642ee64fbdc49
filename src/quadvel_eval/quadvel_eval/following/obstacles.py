"""How far the robot stays from what stands in a world and from the persons there, in the plane, as they really are."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from quadvel_follow.clearance import outline_distance
from quadvel_follow.follow_planner import FollowConfig
from quadvel_sim.world import World

Array = NDArray[np.float64]

APART = 0.03  # m, between two points of an outline
SIGHT = 3.0  # m, to which clearances are looked for
BODY = 0.2  # m, radius of a person


class Clearances:
    """Of a robot with the outline of `config`."""

    def __init__(self, world: World, config: FollowConfig) -> None:
        self._half = 0.5 * config.length, 0.5 * config.width
        self._points = outlines(world)
        self._tree = cKDTree(self._points) if len(self._points) else None

    def of(self, pose: Array) -> float:
        """From the outline at a pose (3,) to what stands, m; inf where nothing does within SIGHT."""
        if self._tree is None or not (near := self._tree.query_ball_point(pose[:2], SIGHT)):
            return float("inf")
        return float(outline_distance(self._points[near], pose, self._half).min())

    def of_persons(self, pose: Array, persons: Array) -> float:
        """From the outline to the nearest of persons (n, 2 or more), m; inf where there are none."""
        return float((outline_distance(persons[:, :2], pose, self._half) - BODY).min(initial=np.inf))


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
