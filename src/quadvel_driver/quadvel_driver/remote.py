"""Commands of the operator from the wireless remote: a velocity, button commands, and a latched stop. No ROS.

    B                      stop: the joints are damped until the stop is released
    L1 + R1 + start        release the stop
    L1 + up, L1 + down     stand up, lie down
    L1 + right, L1 + left  allow walking, forbid it
    left stick             forward and sideways
    right stick            turn

A command is given when its last button goes down. A stopped robot accepts only the release.
"""

from __future__ import annotations

from enum import Enum

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.fields import field

from .board_state import Button, Remote

ZERO_VELOCITY_S = 0.5  # zero velocity after the sticks are released; then other sources take over


class OperatorCommand(Enum):
    """Commands that the buttons give, with the texts shown to the operator."""

    STOP = "stop"
    RELEASE = "release the stop"
    STAND_UP = "stand up"
    LIE_DOWN = "lie down"
    ALLOW_WALKING = "allow walking"
    FORBID_WALKING = "forbid walking"


BUTTONS = {
    OperatorCommand.STOP: Button.B,
    OperatorCommand.RELEASE: Button.L1 | Button.R1 | Button.START,
    OperatorCommand.STAND_UP: Button.L1 | Button.UP,
    OperatorCommand.LIE_DOWN: Button.L1 | Button.DOWN,
    OperatorCommand.ALLOW_WALKING: Button.L1 | Button.RIGHT,
    OperatorCommand.FORBID_WALKING: Button.L1 | Button.LEFT,
}
"""Buttons that must all be down for a command; the first command that matches counts."""


@attrs.frozen(kw_only=True, slots=False)  # for multiple inheritance
class RemoteConfig:
    """Conversion of stick positions to velocities.

    Attributes:
        stick_dead_zone: Share of the stick range, 0 to 1, that counts as released.
        stick_velocity: Velocity at full stick: forward, sideways (m/s), turning (rad/s).

    Raises:
        ValueError: A value is out of range; raised by the constructor.
    """

    stick_dead_zone: float = field(0.08, "share of a stick's range, 0 to 1, that counts as released")
    stick_velocity: tuple[float, ...] = field(
        (0.8, 0.4, 0.8), "velocity at full stick: forward, sideways, turning, m/s, rad/s"
    )

    @stick_dead_zone.validator
    def _is_share(self, attribute: object, value: float) -> None:
        if not 0.0 <= value < 1.0:
            raise ValueError(f"stick_dead_zone is {value}, expected 0 to below 1")

    @stick_velocity.validator
    def _are_speeds(self, attribute: object, value: tuple[float, ...]) -> None:
        if len(value) != 3 or not all(0.0 <= speed < 100.0 for speed in value):
            raise ValueError(f"stick_velocity is {list(value)}, expected three speeds from 0 on")


class RemotePilot:
    """Interprets one remote.

    Attributes:
        stopped: Whether the robot must stay braked; the caller resets it after a release.
    """

    def __init__(self, config: RemoteConfig = RemoteConfig()) -> None:
        self._config = config
        self._buttons = Button(0)
        self._sticks: Array = np.zeros(3)
        self._moved_at: float | None = None
        self.stopped = False

    def update(self, remote: Remote, now: float) -> OperatorCommand | None:
        """Process the present buttons and sticks.

        Args:
            remote: State of the remote.
            now: Time, s.

        Returns:
            The command that was given now, or None.
        """
        sticks = np.array([remote.ly, -remote.lx, -remote.rx])
        self._sticks = np.array(self._config.stick_velocity) * _apply_dead_zone(
            sticks, self._config.stick_dead_zone
        )
        if self._sticks.any():
            self._moved_at = now
        before, self._buttons = self._buttons, remote.buttons
        order = next(
            (order for order, buttons in BUTTONS.items() if remote.buttons & buttons == buttons), None
        )
        if order is None or before & BUTTONS[order] == BUTTONS[order]:
            return None
        if order is OperatorCommand.STOP:
            self.stopped = True
            return order
        return order if self.stopped == (order is OperatorCommand.RELEASE) else None

    def velocity(self, now: float) -> Array | None:
        """Return the velocity that the sticks command.

        Args:
            now: Time, s.

        Returns:
            vx, vy (m/s) and wz (rad/s), (3,); None if the sticks are released for ZERO_VELOCITY_S
            or the robot is stopped.
        """
        if self.stopped or self._moved_at is None or now - self._moved_at > ZERO_VELOCITY_S:
            return None
        return self._sticks.copy()


def _apply_dead_zone(sticks: Array, dead_zone: float) -> Array:
    """Clip sticks to -1..1 and remove the dead zone d: sign(s) max(|s| - d, 0) / (1 - d)."""
    deflection = np.clip(np.abs(sticks), 0.0, 1.0) - dead_zone
    share: Array = np.sign(sticks) * np.maximum(deflection, 0.0) / (1.0 - dead_zone)
    return share
