"""State that a robot's board reports, and the wireless remote, for all packet formats. No ROS.

`packets` and the two `wire` modules decode it, and `health` judges it.
"""

from __future__ import annotations

from enum import IntFlag
from typing import Any

import attrs
from numpy.typing import NDArray

from quadvel_description.state import RobotState


class Button(IntFlag):
    """Buttons of the wireless remote, as bits of the packet."""

    R1, L1, START, SELECT = 0x0001, 0x0002, 0x0004, 0x0008
    R2, L2, F1, F2 = 0x0010, 0x0020, 0x0040, 0x0080
    A, B, X, Y = 0x0100, 0x0200, 0x0400, 0x0800
    UP, RIGHT, DOWN, LEFT = 0x1000, 0x2000, 0x4000, 0x8000


@attrs.frozen
class Remote:
    """State of the wireless remote.

    Attributes:
        buttons: Pressed buttons.
        lx: Left stick to the right, -1 to 1.
        ly: Left stick forward, -1 to 1.
        rx: Right stick to the right, -1 to 1.
        ry: Right stick forward, -1 to 1. All sticks are 0 if the remote is off.
    """

    buttons: Button = Button(0)
    lx: float = 0.0
    ly: float = 0.0
    rx: float = 0.0
    ry: float = 0.0


@attrs.frozen
class Battery:
    """State of the battery.

    Attributes:
        charge: State of charge, %, 0 to 100.
        voltage: V.
        current: A, negative while the battery discharges.
    """

    charge: int
    voltage: float
    current: float


@attrs.define
class BoardState:
    """State as the board sends it.

    Attributes:
        robot: State of the robot; `tick` is the board's counter in its own unit, `time` is 0, and
            `foot_force` holds raw sensor counts.
        motor_mode: (12,), in the codes of the board.
        motor_error: (12,), in the codes of the board, 0 for none.
        temperature: Motor temperatures, (12,), deg C.
        imu_temperature: deg C.
        remote: State of the wireless remote.
        battery: State of the battery; None if the board does not report it.
    """

    robot: RobotState
    motor_mode: NDArray[Any]
    motor_error: NDArray[Any]
    temperature: NDArray[Any]
    imu_temperature: int = 0
    remote: Remote = Remote()
    battery: Battery | None = None
