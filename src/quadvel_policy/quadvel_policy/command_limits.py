"""Limits on joint commands: target range, torque step, torque, speed and power. Knows no ROS.

All limits act on the torque of a command at the present joint state: a target is moved towards the
joint until its torque is allowed. Damping commands are never limited.
"""

from __future__ import annotations

from collections import Counter

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.command_range import clip_to_command_range, split_target
from quadvel_description.fields import positive
from quadvel_description.robot import Robot
from quadvel_description.state import MODE_DAMPING, JointCommand, RobotState

MAX_TORQUE_NM, MAX_POWER_W = 1000.0, 1e5
"""More than the drives of such robots can do; `SupervisorConfig.check` compares with those of a robot."""
LIMITS = {
    "target_out_of_range": "A target lies beyond the command range: it is clamped, and the rest is sent as torque.",
    "torque_jumps": "The commanded torque changes by more than `max_torque_step` in one tick.",
    "torque_too_large": "The commanded torque exceeds the limit of the drive.",
    "joint_at_speed_limit": "A joint is at the speed limit of its drive: no torque accelerates it further.",
    "power_too_large": "The commanded power of all joints exceeds `max_power`.",
}
"""Condition of each limit by name, in the order in which they act."""


@attrs.frozen(kw_only=True)
class JointCommandLimits:
    """Limits on joint commands, in addition to the robot's; each field is a node parameter."""

    max_torque_step: float = positive(
        30.0, "largest change of a joint's torque from tick to tick, N m", at_most=2.0 * MAX_TORQUE_NM
    )
    max_power: float = positive(
        1800.0, "largest mechanical power of all joints together, W", at_most=MAX_POWER_W
    )


class JointCommandLimiter:
    """Applies the limits to joint commands.

    Attributes:
        counts: Number of ticks in which each of LIMITS acted, since the start.
    """

    def __init__(self, robot: Robot, config: JointCommandLimits) -> None:
        self._config = config
        self._robot = robot
        self._torque_limit, self._velocity_limit = robot.torque_limit, robot.velocity_limit
        self.counts: Counter[str] = Counter()

    def apply(self, command: JointCommand, before: Array, state: RobotState) -> None:
        """Limit a command in place.

        Args:
            command: The command that answers `state`; changed in place.
            before: Torque that the command of the previous tick asks for at `state`, (12,), N m.
            state: The measured state.
        """
        if command.mode == MODE_DAMPING:
            return
        target = command.q
        command.q = clip_to_command_range(self._robot, target)
        if np.count_nonzero(command.q != target):
            command.q, torque = split_target(self._robot, target, command.kp, state.q)
            command.tau = command.tau + torque
            self.counts["target_out_of_range"] += 1
        requested = command.torque(state.q, state.dq)
        if self._is_within_all(requested, before, state.dq):  # the usual case
            return
        allowed = self._limit_step(requested, before)
        allowed = self._limit_torque(allowed)
        allowed = self._limit_at_top_speed(allowed, state.dq)
        allowed = self._limit_power(allowed, state.dq)
        if np.count_nonzero(allowed != requested):
            _add_torque(self._robot, command, allowed - requested)

    def _is_within_all(self, torque: Array, before: Array, speed: Array) -> bool:
        """Return whether surely no limit acts: sum(|tau| |dq|) is at least the power that counts."""
        strength, speed = np.abs(torque), np.abs(speed)
        within = np.abs(torque - before) <= self._config.max_torque_step
        within &= (strength <= self._torque_limit) & (speed < self._velocity_limit)
        return bool(np.count_nonzero(within) == 12 and strength @ speed <= self._config.max_power)

    def _count(self, name: str, acts: bool | np.bool_) -> None:
        if acts:
            self.counts[name] += 1

    def _limit_step(self, torque: Array, before: Array) -> Array:
        step = self._config.max_torque_step
        held_torque: Array = np.minimum(np.maximum(torque, before - step), before + step)
        self._count("torque_jumps", np.count_nonzero(held_torque != torque) > 0)
        return held_torque

    def _limit_torque(self, torque: Array) -> Array:
        limit = self._torque_limit
        held_torque: Array = np.minimum(np.maximum(torque, -limit), limit)
        self._count("torque_too_large", np.count_nonzero(held_torque != torque) > 0)
        return held_torque

    def _limit_at_top_speed(self, torque: Array, speed: Array) -> Array:
        at_limit = np.abs(speed) >= self._velocity_limit
        if not np.count_nonzero(at_limit) or not np.count_nonzero(
            faster := at_limit & (torque * speed > 0.0)
        ):
            return torque
        self._count("joint_at_speed_limit", True)
        return np.where(faster, 0.0, torque)

    def _limit_power(self, torque: Array, speed: Array) -> Array:
        power = torque * speed
        total, limit = float(np.maximum(power, 0.0).sum()), self._config.max_power
        if total <= limit:
            return torque
        self._count("power_too_large", True)
        return np.where(power > 0.0, torque * limit / total, torque)


def _add_torque(robot: Robot, command: JointCommand, change: Array) -> None:
    """Change the torque of a command by `change` (12,) N m.

        q_des' = clamp(q_des + change / kp),   tau_ff' = tau_ff + change - kp (q_des' - q_des)

    The target takes as much of the change as stiffness and range allow; feed-forward torque the
    rest.
    """
    shift = np.divide(change, command.kp, out=np.zeros(12), where=command.kp > 0.0)
    q = np.where(shift == 0.0, command.q, clip_to_command_range(robot, command.q + shift))
    command.tau = command.tau + change - command.kp * (q - command.q)
    command.q = q
