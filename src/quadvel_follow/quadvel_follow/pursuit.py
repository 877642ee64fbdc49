"""Pure-pursuit candidates: straight to a goal or along parallel lanes, at several speeds.

They ignore obstacles; the search rates them.
"""

from __future__ import annotations

import numpy as np

from quadvel_description.arrays import Array

from .rollouts import STEP_S, STEPS, Limits

LANE_OFFSETS_M = np.array([0.0, 0.12, -0.12, 0.25, -0.25, 0.45, -0.45, 0.8, -0.8])
"""Lateral offsets of the lanes from the straight line, positive to the left."""
SPEED_SHARES = np.array([1.0, 0.7, 0.4])
LOOKAHEAD_M = 0.8
"""Lookahead distance along the lane."""
DISTANCE_GAIN = 1.2
"""Speed by distance error, 1/s."""
HEADING_GAIN = 2.5
"""Turn rate by heading error, 1/s."""


def pursue(pose: Array, goal: Array, left: Array, speed: float, limits: Limits) -> Array:
    """Compute candidate targets that lead to a goal.

    Args:
        pose: Pose of the robot, (3,): x, y in m, yaw in rad.
        goal: Goal, (2,), m.
        left: Distance left to the goal from the start, at each step of a moving goal, (STEPS,), m.
        speed: Speed of the goal, m/s.
        limits: Limits of the commands.

    Returns:
        Targets, (lanes x speeds, STEPS, 3): vx, vy in m/s, wz in rad/s.
    """
    lane, share = (each.ravel() for each in np.meshgrid(LANE_OFFSETS_M, SPEED_SHARES, indexing="ij"))
    off = goal - pose[:2]
    direction = np.arctan2(off[1], off[0])
    along, aside, yaw = np.zeros_like(lane), np.zeros_like(lane), np.full_like(lane, pose[2] - direction)
    found = np.zeros((len(lane), STEPS, 3))
    for step in range(STEPS):
        turn = np.arctan2(lane - aside, LOOKAHEAD_M) - yaw
        turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
        pace = share * np.maximum(speed + DISTANCE_GAIN * (left[step] - along), 0.0)
        pace *= np.maximum(np.cos(turn), 0.0) ** 4
        found[:, step] = limits.clip(np.column_stack([pace, np.zeros_like(pace), HEADING_GAIN * turn]))
        yaw = yaw + STEP_S * found[:, step, 2]
        along = along + STEP_S * found[:, step, 0] * np.cos(yaw)
        aside = aside + STEP_S * found[:, step, 0] * np.sin(yaw)
    return found
