"""Computes the true clearance of the robot from obstacles and people in the plane."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from quadvel_description.arrays import Array
from quadvel_follow.clearance import outline_distance
from quadvel_follow.follow_planner import FollowConfig
from quadvel_sim.world import World

OUTLINE_SPACING_M = 0.03  # between points of an outline
SEARCH_RADIUS_M = 3.0  # for obstacles
PERSON_RADIUS_M = 0.2


class Clearances:
    """Clearances of a robot in a world.

    Args:
        world: Walls, boxes, trees and tables.
        config: Parameters with the outline of the robot.
    """

    def __init__(self, world: World, config: FollowConfig) -> None:
        self._half = 0.5 * config.length, 0.5 * config.width
        self._points = outline_points(world)
        self._tree = cKDTree(self._points) if len(self._points) else None

    def to_obstacles(self, pose: Array) -> float:
        """Return the distance from the robot's outline to the nearest obstacle; negative on contact.

        Args:
            pose: x, y (m) and yaw (rad) of the robot (3,).

        Returns:
            Distance, m; inf if none is within SEARCH_RADIUS_M of the robot's centre.
        """
        if self._tree is None or not (near := self._tree.query_ball_point(pose[:2], SEARCH_RADIUS_M)):
            return float("inf")
        return float(outline_distance(self._points[near], pose, self._half).min())

    def to_people(self, pose: Array, people: Array) -> float:
        """Return the distance from the robot's outline to the nearest person; negative on contact.

        Args:
            pose: x, y (m) and yaw (rad) of the robot (3,).
            people: Positions of the people (n, 2 or more), m.

        Returns:
            Distance, m; inf without people.
        """
        return float(
            (outline_distance(people[:, :2], pose, self._half) - PERSON_RADIUS_M).min(initial=np.inf)
        )


def outline_points(world: World) -> Array:
    """Sample the outlines of walls, boxes and trees; a table leg is one point.

    Args:
        world: The world.

    Returns:
        Points (n, 2), m, OUTLINE_SPACING_M apart.
    """
    found = [
        _rectangle(
            0.5 * (a + b), (np.hypot(*(b - a)) + wall.thickness, wall.thickness), np.arctan2(*(b - a)[::-1])
        )
        for wall in world.walls
        for a, b in pairwise(wall.points)
    ]
    found += [_rectangle(box.position, box.size[:2], np.radians(box.yaw)) for box in world.boxes]
    found += [_circle(position, group.radius) for group in world.trees for position in group.positions]
    found += [table.legs for table in world.tables]
    return np.concatenate(found) if found else np.zeros((0, 2))


def _circle(middle: Array, radius: float) -> Array:
    """Points on a circle."""
    angle = np.linspace(0.0, 2.0 * np.pi, 4 + int(2.0 * np.pi * radius / OUTLINE_SPACING_M), endpoint=False)
    return middle + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _rectangle(middle: ArrayLike, size: ArrayLike, yaw: float) -> Array:
    """Points on the edge of a rectangle of `size` (2,) m, rotated by `yaw` rad."""
    half = 0.5 * np.asarray(size, float)
    corners = half * [[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]
    edges = [
        a + np.linspace(0.0, 1.0, 2 + int(np.hypot(*(b - a)) / OUTLINE_SPACING_M))[:, None] * (b - a)
        for a, b in pairwise(corners)
    ]
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(middle, float) + np.concatenate(edges) @ np.array([[c, s], [-s, c]])
