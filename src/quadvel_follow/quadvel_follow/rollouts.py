"""Prediction of the robot's motion under velocity commands: limits, first-order lag, and poses.

`dynamic_window` searches the commands and `follow_costs` rates the rollouts. Velocities are in the
body frame, poses in the frame of the given pose (odometry).
"""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array

Axes = tuple[float, float, float]

STEP_S = 0.125
"""Time between two steps of a rollout, s."""
STEPS = 14
"""Number of steps of a rollout."""
LAG_S = 0.2
"""Time constant from command to velocity, s: delay and first-order lag together."""


@attrs.frozen
class Limits:
    """Limits of the commands vx, vy (m/s), wz (rad/s).

    Attributes:
        velocity: Largest |vx|, |vy| (m/s) and |wz| (rad/s); an ellipse limits vx and vy together.
        backward: Largest backward speed, m/s.
        curve: Largest |wz| (|vx| + |vy|), m/s^2.
        acceleration: Largest rates of change away from zero, m/s^2, m/s^2, rad/s^2.
        deceleration: Largest rates of change toward zero, m/s^2, m/s^2, rad/s^2.
    """

    velocity: Axes
    backward: float
    curve: float
    acceleration: Axes
    deceleration: Axes

    def clip(self, commands: ArrayLike) -> Array:
        """Clip commands to the limits of velocity.

        Args:
            commands: Commands, (..., 3): vx, vy in m/s, wz in rad/s.

        Returns:
            Clipped commands, (..., 3).
        """
        found = np.clip(commands, np.negative(self.velocity), self.velocity)
        found[..., 0] = np.maximum(found[..., 0], -self.backward)
        out = np.hypot(found[..., 0] / self.velocity[0], found[..., 1] / self.velocity[1])
        found[..., :2] /= np.maximum(out, 1.0)[..., None]
        turn = self.curve / np.maximum(np.abs(found[..., 0]) + np.abs(found[..., 1]), 1e-3)
        found[..., 2] = np.clip(found[..., 2], -turn, turn)
        return found

    def ramp(self, before: Array, target: Array, seconds: float) -> Array:
        """Move commands toward targets within the limits of acceleration.

        Args:
            before: Present commands, (..., 3): vx, vy in m/s, wz in rad/s.
            target: Targets, (..., 3), in the same units.
            seconds: Time, s.

        Returns:
            Commands after that time, (..., 3).
        """
        slower = np.abs(target) < np.abs(before)
        step = seconds * np.where(slower, self.deceleration, self.acceleration)
        return before + np.clip(target - before, -step, step)


@attrs.frozen
class Rollouts:
    """Predicted motions for K sequences of targets.

    Attributes:
        commands: Commands, (K, STEPS, 3): vx, vy in m/s, wz in rad/s, body frame.
        velocity: Predicted velocities of the robot, shape, units and frame as `commands`.
        poses: Poses at `TIMES_S`, (K, STEPS, 3): x, y in m, yaw in rad.
    """

    commands: Array
    velocity: Array
    poses: Array


# First-order lag in closed form, with a = exp(-dt / LAG_S):
# v_t = sum_{s <= t} (1 - a) a^(t - s) u_s + a^(t + 1) v_0.
_STEPS_AGO = np.arange(STEPS)[:, None] - np.arange(STEPS)
_DECAY = np.exp(-STEP_S / LAG_S)
_RESPONSE = np.where(
    _STEPS_AGO >= 0, (1.0 - _DECAY) * _DECAY ** np.maximum(_STEPS_AGO, 0), 0.0
)  # (STEPS, STEPS)
_INITIAL_DECAY = _DECAY ** np.arange(1, STEPS + 1)
TIMES_S = STEP_S * np.arange(1, STEPS + 1)
"""Times of the poses from now, (STEPS,), s."""


def roll_out(targets: Array, pose: Array, velocity: Array, command: Array, limits: Limits) -> Rollouts:
    """Predict the motion for sequences of targets.

    Args:
        targets: Targets, (K, STEPS, 3): vx, vy in m/s, wz in rad/s.
        pose: Present pose, (3,): x, y in m, yaw in rad.
        velocity: Present velocity, (3,): vx, vy in m/s, wz in rad/s, body frame.
        command: Present command, (3,), in the same units and frame.
        limits: Limits of the commands.

    Returns:
        The rollouts.
    """
    commands = np.empty_like(targets)
    last = np.broadcast_to(command, targets[:, 0].shape)
    for step in range(STEPS):
        last = limits.ramp(last, targets[:, step], STEP_S)
        commands[:, step] = last
    followed = np.einsum("ts,ksa->kta", _RESPONSE, commands) + _INITIAL_DECAY[:, None] * velocity
    return Rollouts(commands, followed, _poses(followed, pose, velocity))


def _poses(followed: Array, pose: Array, velocity: Array) -> Array:
    """Integrate velocities (K, STEPS, 3) with the midpoint rule."""
    before = np.concatenate([np.broadcast_to(velocity, followed[:, :1].shape), followed[:, :-1]], axis=1)
    mean = 0.5 * (before + followed)
    yaw = pose[2] + STEP_S * np.cumsum(mean[..., 2], axis=1)
    middle = yaw - 0.5 * STEP_S * mean[..., 2]
    c, s = np.cos(middle), np.sin(middle)
    x = pose[0] + STEP_S * np.cumsum(c * mean[..., 0] - s * mean[..., 1], axis=1)
    y = pose[1] + STEP_S * np.cumsum(s * mean[..., 0] + c * mean[..., 1], axis=1)
    return np.stack([x, y, yaw], axis=-1)
