"""The last look at what the joints are asked for: no target, torque, speed or power beyond the limits leaves the controller.

All limits act on the torque that a command gives where the joints are now; a target moves towards the joint until it asks
for what is allowed. Braking is never limited. Knows no ROS.
"""

from __future__ import annotations

from collections import Counter

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.command_range import clip_to_command_range, split_target
from quadvel_description.robot import TORQUE_LIMIT, VELOCITY_LIMIT
from quadvel_description.state import MODE_DAMPING, JointCommand, RobotState

from .settings import setting

Array = NDArray[np.float64]

LIMITS = {
    "target_out_of_range": "A target lies beyond the range of commands: it is held there, the rest goes as torque.",
    "torque_jumps": "The torque asked for changes by more than `max_torque_step` in one tick.",
    "torque_too_large": "More torque is asked for than the drive can give.",
    "joint_at_speed_limit": "A joint is at the speed that its drive can do: nothing drives it faster.",
    "power_too_large": "The joints are asked for more than `max_power` together.",
}
"""Name and what is noticed of each limit, in the order in which they act"""


@attrs.frozen(kw_only=True, slots=False)  # for classes that have other bases besides
class CommandLimitsConfig:
    """What the joints may be asked for beyond the robot's own limits."""

    max_torque_step: float = setting(
        30.0,
        "largest change of a joint's torque from tick to tick, N m",
        at_most=2.0 * float(TORQUE_LIMIT.max()),  # from one end of what a drive can do to the other
    )
    max_power: float = setting(
        1800.0,
        "largest mechanical power of all joints together, W",
        at_most=float(TORQUE_LIMIT @ VELOCITY_LIMIT),  # of drives that give all they can
    )


class CommandLimits:
    """Holds commands within the limits. counts: in how many ticks each of LIMITS acted since the start."""

    def __init__(self, config: CommandLimitsConfig) -> None:
        self._config = config
        self.counts: Counter[str] = Counter()

    def apply(self, command: JointCommand, previous: JointCommand, state: RobotState) -> None:
        """Change `command`, which is to answer `state` after `previous`, where it is beyond a limit."""
        if command.mode == MODE_DAMPING:
            return
        beyond = (command.q != clip_to_command_range(command.q)).any()
        command.q, torque = split_target(command.q, command.kp, state.q)
        command.tau = command.tau + torque
        self._count("target_out_of_range", beyond)
        asked = command.torque(state.q, state.dq)
        allowed = self._after_step(asked, previous.torque(state.q, state.dq))
        allowed = self._at_most(allowed)
        allowed = self._at_speed(allowed, state.dq)
        allowed = self._of_power(allowed, state.dq)
        if np.count_nonzero(allowed != asked):
            _ask_for(command, allowed - asked)

    def _count(self, name: str, acts: bool | np.bool_) -> None:
        if acts:
            self.counts[name] += 1

    def _after_step(self, torque: Array, before: Array) -> Array:
        step = self._config.max_torque_step
        held_torque: Array = np.minimum(np.maximum(torque, before - step), before + step)
        self._count("torque_jumps", np.count_nonzero(held_torque != torque) > 0)
        return held_torque

    def _at_most(self, torque: Array) -> Array:
        held_torque: Array = np.minimum(np.maximum(torque, -TORQUE_LIMIT), TORQUE_LIMIT)
        self._count("torque_too_large", np.count_nonzero(held_torque != torque) > 0)
        return held_torque

    def _at_speed(self, torque: Array, speed: Array) -> Array:
        faster = (np.abs(speed) >= VELOCITY_LIMIT) & (torque * speed > 0.0)
        if not np.count_nonzero(faster):
            return torque
        self._count("joint_at_speed_limit", True)
        return np.where(faster, 0.0, torque)

    def _of_power(self, torque: Array, speed: Array) -> Array:
        power = torque * speed
        total, limit = float(np.maximum(power, 0.0).sum()), self._config.max_power
        if total <= limit:
            return torque
        self._count("power_too_large", True)
        return np.where(power > 0.0, torque * limit / total, torque)


def _ask_for(command: JointCommand, change: Array) -> None:
    """Change the torque by `change` (12,) N m: by the target as far as there is stiffness and range, else by feed-forward."""
    way = np.divide(change, command.kp, out=np.zeros(12), where=command.kp > 0.0)
    q = np.where(way == 0.0, command.q, clip_to_command_range(command.q + way))
    command.tau = command.tau + change - command.kp * (q - command.q)
    command.q = q
