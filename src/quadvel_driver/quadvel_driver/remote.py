"""What the operator wants, told from the wireless remote: a velocity, orders, and a stop that stays. No ROS.

    B                      stop: the joints are damped at once and stay so
    L1 + R1 + start        release the stop
    L1 + up, L1 + down     stand up, lie down
    L1 + right, L1 + left  allow walking, forbid it
    left stick             forward and sideways
    right stick            turn

An order is given when its last button goes down. While the robot is stopped nothing counts but the release.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from .wire import Button, Remote

AFTERGLOW = 0.5  # s of zeros once the sticks are let go; then whoever else commands has its turn


class Order(Enum):
    """What buttons ask for, in words that are shown to people."""

    STOP = "stop"
    RELEASE = "release the stop"
    STAND_UP = "stand up"
    LIE_DOWN = "lie down"
    ALLOW_WALKING = "allow walking"
    FORBID_WALKING = "forbid walking"


BUTTONS = {
    Order.STOP: Button.B,
    Order.RELEASE: Button.L1 | Button.R1 | Button.START,
    Order.STAND_UP: Button.L1 | Button.UP,
    Order.LIE_DOWN: Button.L1 | Button.DOWN,
    Order.ALLOW_WALKING: Button.L1 | Button.RIGHT,
    Order.FORBID_WALKING: Button.L1 | Button.LEFT,
}
"""What must be held down for each; the first that fits counts."""


def _setting(default: Any, description: str) -> Any:
    return attrs.field(default=default, metadata={"description": description})


@attrs.frozen(kw_only=True, slots=False)  # to stand beside another base
class RemoteConfig:
    """How sticks become velocities. Raises ValueError where a number can't be."""

    stick_dead_zone: float = _setting(0.08, "share of a stick's way, 0 to 1, that counts as let go")
    stick_velocity: tuple[float, ...] = _setting(
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
    """Follows one remote. stopped: whether the robot has to stay braked; whoever releases it sets it back."""

    def __init__(self, config: RemoteConfig = RemoteConfig()) -> None:
        self._config = config
        self._buttons = Button(0)
        self._sticks: NDArray[np.float64] = np.zeros(3)
        self._moved_at: float | None = None
        self.stopped = False

    def follow(self, remote: Remote, now: float) -> Order | None:
        """Take what is held down now; the order that was given with it. now: s."""
        sticks = np.array([remote.ly, -remote.lx, -remote.rx])
        self._sticks = np.array(self._config.stick_velocity) * _beyond(sticks, self._config.stick_dead_zone)
        if self._sticks.any():
            self._moved_at = now
        before, self._buttons = self._buttons, remote.buttons
        order = next(
            (order for order, buttons in BUTTONS.items() if remote.buttons & buttons == buttons), None
        )
        if order is None or before & BUTTONS[order] == BUTTONS[order]:
            return None
        if order is Order.STOP:
            self.stopped = True
            return order
        return order if self.stopped == (order is Order.RELEASE) else None

    def velocity(self, now: float) -> NDArray[np.float64] | None:
        """vx, vy (m/s), wz (rad/s); None where the sticks have been let go for a while, or the robot is stopped."""
        if self.stopped or self._moved_at is None or now - self._moved_at > AFTERGLOW:
            return None
        return self._sticks.copy()


def _beyond(sticks: NDArray[np.float64], dead_zone: float) -> NDArray[np.float64]:
    """Sticks held to -1..1, less the dead zone, growing from 0 at its edge to 1 at the stop."""
    way = np.clip(np.abs(sticks), 0.0, 1.0) - dead_zone
    share: NDArray[np.float64] = np.sign(sticks) * np.maximum(way, 0.0) / (1.0 - dead_zone)
    return share
