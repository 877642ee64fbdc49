"""What becomes of a robot that is commanded velocities: how fast commands may change, and how the robot follows them."""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Axes = tuple[float, float, float]

STEP = 0.125  # s
STEPS = 14
LAG = 0.2  # s, from a command to the robot's velocity: its delay and its first-order lag together


@attrs.frozen
class Limits:
    """Of commands, each for vx, vy (m/s), wz (rad/s).

    velocity: vx and vy keep to an ellipse; backward: m/s, largest -vx; curve: m/s^2, largest |wz| (|vx| + |vy|);
    acceleration, deceleration: largest change of a command away from zero, and towards it.
    """

    velocity: Axes
    backward: float
    curve: float
    acceleration: Axes
    deceleration: Axes

    def held(self, commands: ArrayLike) -> Array:
        """Commands (..., 3) held to these limits."""
        found = np.clip(commands, np.negative(self.velocity), self.velocity)
        found[..., 0] = np.maximum(found[..., 0], -self.backward)
        out = np.hypot(found[..., 0] / self.velocity[0], found[..., 1] / self.velocity[1])
        found[..., :2] /= np.maximum(out, 1.0)[..., None]
        turn = self.curve / np.maximum(np.abs(found[..., 0]) + np.abs(found[..., 1]), 1e-3)
        found[..., 2] = np.clip(found[..., 2], -turn, turn)
        return found

    def ramped(self, before: Array, target: Array, seconds: float) -> Array:
        """From the commands `before` (..., 3) towards `target` (..., 3), as far as `seconds` allow."""
        slower = np.abs(target) < np.abs(before)
        step = seconds * np.where(slower, self.deceleration, self.acceleration)
        return before + np.clip(target - before, -step, step)


@attrs.frozen
class Rollouts:
    """commands, velocity (K, STEPS, 3): vx, vy (m/s), wz (rad/s), body frame; poses (K, STEPS, 3): x, y (m), yaw (rad)."""

    commands: Array
    velocity: Array
    poses: Array


_AGO = np.arange(STEPS)[:, None] - np.arange(STEPS)
_KEPT = np.exp(-STEP / LAG)
_FOLLOWS = np.where(_AGO >= 0, (1.0 - _KEPT) * _KEPT ** np.maximum(_AGO, 0), 0.0)  # (STEPS, STEPS)
_STAYS = _KEPT ** np.arange(1, STEPS + 1)
TIMES = STEP * np.arange(1, STEPS + 1)
"""(STEPS,) s, of the poses."""


def roll_out(targets: Array, pose: Array, velocity: Array, command: Array, limits: Limits) -> Rollouts:
    """targets (K, STEPS, 3): the commands wanted; pose, velocity, command (3,): now."""
    commands = np.empty_like(targets)
    last = np.broadcast_to(command, targets[:, 0].shape)
    for step in range(STEPS):
        last = limits.ramped(last, targets[:, step], STEP)
        commands[:, step] = last
    followed = np.einsum("ts,ksa->kta", _FOLLOWS, commands) + _STAYS[:, None] * velocity
    return Rollouts(commands, followed, _poses(followed, pose, velocity))


def _poses(followed: Array, pose: Array, velocity: Array) -> Array:
    """Velocities (K, STEPS, 3) at the ends of the steps, added up."""
    before = np.concatenate([np.broadcast_to(velocity, followed[:, :1].shape), followed[:, :-1]], axis=1)
    mean = 0.5 * (before + followed)
    yaw = pose[2] + STEP * np.cumsum(mean[..., 2], axis=1)
    middle = yaw - 0.5 * STEP * mean[..., 2]
    c, s = np.cos(middle), np.sin(middle)
    x = pose[0] + STEP * np.cumsum(c * mean[..., 0] - s * mean[..., 1], axis=1)
    y = pose[1] + STEP * np.cumsum(s * mean[..., 0] + c * mean[..., 1], axis=1)
    return np.stack([x, y, yaw], axis=-1)
