"""Ways that may be good: straight towards a goal, or along a lane beside that line, at several speeds. They see no obstacles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .rollouts import STEP, STEPS, Limits

Array = NDArray[np.float64]

LANES = np.array([0.0, 0.12, -0.12, 0.25, -0.25, 0.45, -0.45, 0.8, -0.8])  # m, to the left of the line
SHARES = np.array([1.0, 0.7, 0.4])  # of the speed
AHEAD = 0.8  # m, along the lane, to where the robot looks
CLOSES = 1.2  # 1/s, of the distance that is too large
TURNS = 2.5  # 1/s, of the heading


def pursue(pose: Array, goal: Array, left: Array, speed: float, limits: Limits) -> Array:
    """Targets (lanes x shares, STEPS, 3) from `pose` (3,).

    goal (2,): m; left (STEPS,): m that are left to walk at the start, as they are at each step where the goal walks;
    speed: m/s, of the goal.
    """
    lane, share = (each.ravel() for each in np.meshgrid(LANES, SHARES, indexing="ij"))
    off = goal - pose[:2]
    direction = np.arctan2(off[1], off[0])
    along, aside, yaw = np.zeros_like(lane), np.zeros_like(lane), np.full_like(lane, pose[2] - direction)
    found = np.zeros((len(lane), STEPS, 3))
    for step in range(STEPS):
        turn = np.arctan2(lane - aside, AHEAD) - yaw
        turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
        pace = share * np.maximum(speed + CLOSES * (left[step] - along), 0.0)
        pace *= np.maximum(np.cos(turn), 0.0) ** 4
        found[:, step] = limits.held(np.column_stack([pace, np.zeros_like(pace), TURNS * turn]))
        yaw = yaw + STEP * found[:, step, 2]
        along = along + STEP * found[:, step, 0] * np.cos(yaw)
        aside = aside + STEP * found[:, step, 0] * np.sin(yaw)
    return found
