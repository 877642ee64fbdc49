"""`quadvel teleop`: drive the robot by the keys of a terminal or by a gamepad.

Needs `rclpy`: ROS 2's own, or the embedded one after `quadvel_dds.install()`.
"""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import attrs
import numpy as np
from geometry_msgs.msg import Twist
from rich.console import Console
from rich.text import Text

from quadvel_msgs.msg import ControllerState
from quadvel_msgs.srv import SetMode
from quadvel_view import gamepad, keyboard
from quadvel_view.gamepad import AxisRange, Gamepad
from quadvel_view.keyboard import Keyboard, split_keys
from quadvel_view.operator import PUBLISH_PERIOD_S, Operator

from .drive import twist_to_array, velocity_text
from .operator_commands import START_HINT
from .processes import StopSignals
from .session import DISCOVERY_TIMEOUT_S, Session, not_running

MODE_KEYS = {"u": "stand_up", "x": "lie_down"}
HOLDER_ID = "hand"
SILENCE_NOTE = f"gamepad silent for {gamepad.SILENCE_TIMEOUT_S:g} s: press the dead-man's button again   "


@attrs.frozen
class RecoveryKeys:
    """Inputs of a device for recovery.

    Attributes:
        release: Releases the STOP.
        recover: Stands up again after a fault.
    """

    release: str
    recover: str


KEYS = RecoveryKeys(release="r", recover="space, r, then u")
BUTTONS = RecoveryKeys(release="start", recover="B, start, then `quadvel mode stand_up`")


def state_line(state: Any, stopped: bool, speed: float, way_out: RecoveryKeys) -> str:
    """Describe the robot in one line.

    Args:
        state: The last ControllerState.
        stopped: Whether STOP is latched.
        speed: Selected forward speed, m/s.
        way_out: Inputs of the device for recovery.

    Returns:
        Mode, speed and command, or the fault and the way out of it.
    """
    stop = f"STOPPED, {way_out.release} releases   " if stopped else ""
    if state.mode_name == "fault":
        return f"{stop}fault: {state.reason}   once the cause is gone: {way_out.recover}"
    return f"{stop}{state.mode_name}   speed {speed:.1f} m/s   {velocity_text(twist_to_array(state.command))}"


class Teleop:
    """Publishes the operator's commands and receives the controller's state.

    Args:
        session: The node that it uses.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._operator = Operator()
        self._publisher = session.node.create_publisher(Twist, "cmd_vel_teleop", 10)
        self._states = session.listen(ControllerState, "controller/state")
        self._set_mode = session.node.create_client(SetMode, "controller/set_mode")
        self._asked_at = 0.0

    def wait_for_robot(self) -> None:
        """Wait for the controller.

        Raises:
            NotRunningError: There is no controller.
        """
        if not self._session.spin_until(
            lambda: self._states and self._set_mode.service_is_ready(), DISCOVERY_TIMEOUT_S
        ):
            raise not_running(self._session.node, f"controller/state: no message; {START_HINT}")

    def execute(self, order: str) -> None:
        """Execute an order.

        Args:
            order: "stop", "release", or a mode, which STOP blocks; "" does nothing.
        """
        if order == "stop":
            self._operator.stop()
            self._ask("passive")
        elif order == "release":
            self._operator.release()
        elif order and not self._operator.stopped:
            self._ask(order)

    def serve_period(self, velocity: Any) -> None:
        """Publish the velocity of one period.

        Args:
            velocity: Velocity that the operator holds, (3,): vx, vy (m/s), wz (rad/s), body frame;
                None if nothing is held.
        """
        now = time.monotonic()
        if velocity is None:
            self._operator.end_hold(HOLDER_ID, now)
        else:
            self._operator.hold(HOLDER_ID, velocity, now)
        self._publish(self._operator.velocity(now))
        mode = self._states[-1].mode_name if self._states else ""
        if self._operator.should_resend_stop(mode, now - self._asked_at):
            self._ask("passive")
        self._session.spin(PUBLISH_PERIOD_S)

    def status_line(self, speed: float, way_out: RecoveryKeys) -> str:
        """Describe the robot as `state_line` does.

        Args:
            speed: Selected forward speed, m/s.
            way_out: Inputs of the device for recovery.

        Returns:
            One line.
        """
        return state_line(self._states[-1], self._operator.stopped, speed, way_out)

    def send_zero(self) -> None:
        """Publish a final zero velocity."""
        self._publish(np.zeros(3))

    def _publish(self, velocity: Any) -> None:
        """Publish a velocity, if there is one."""
        if velocity is not None:
            twist = Twist()
            twist.linear.x, twist.linear.y, twist.angular.z = velocity.tolist()
            self._publisher.publish(twist)

    def _ask(self, mode: str) -> None:
        """Request a mode without waiting for the answer."""
        self._asked_at = time.monotonic()
        self._set_mode.call_async(SetMode.Request(mode=mode))


def drive_by_keyboard() -> int:
    """Drive by the terminal's keys until Ctrl-C.

    Returns:
        The exit code.

    Raises:
        ValueError: Standard input is not a terminal.
    """
    if not sys.stdin.isatty():
        raise ValueError("standard input is not a terminal: quadvel teleop reads keys from one")
    keys = Keyboard()

    def hear(teleop: Teleop) -> Any:
        """Process the pressed keys and return the velocity."""
        for key in split_keys(_pending_input()):
            if key in (" ", "r"):
                keys.release()
                teleop.execute("stop" if key == " " else "release")
            elif key in MODE_KEYS:
                teleop.execute(MODE_KEYS[key])
            keys.press(key, time.monotonic())
        return keys.velocity(time.monotonic())

    print(_help_text(keyboard))
    with _cbreak_terminal():
        _drive(hear, lambda: keys.speed, KEYS)
    return 0


def drive_by_gamepad() -> int:
    """Drive by a gamepad until Ctrl-C. Raises ValueError if there is none.

    Returns:
        The exit code.
    """
    device = _find_gamepad()
    spans = {code: AxisRange(info.min, info.max) for code, info in device.capabilities()[gamepad.ABSOLUTE]}
    pad = Gamepad(spans)

    def hear(teleop: Teleop) -> Any:
        """Process the events of the gamepad and return the velocity."""
        try:
            while (event := device.read_one()) is not None:
                order = pad.handle_event(event.type, event.code, event.value)
                teleop.execute(restore_gamepad(pad, device) if order == "restore" else order)
        except OSError:
            raise ValueError(f"{device.name}: the gamepad was disconnected") from None
        return pad.velocity()

    print(_help_text(gamepad))
    print(f"by {device.name}")
    _drive(hear, lambda: pad.speed, BUTTONS, lambda: SILENCE_NOTE if pad.timed_out else "")
    return 0


def _help_text(module: ModuleType) -> str:
    """Return the help for the operator: the docstring of a module without its first paragraph."""
    return "".join(str(module.__doc__).partition("\n\n")[1:]).strip("\n")


def restore_gamepad(pad: Gamepad, device: Any) -> str:
    """Read the state of an evdev device after the kernel lost events.

    Args:
        pad: The gamepad to update.
        device: The evdev device.

    Returns:
        "stop" if the STOP button is pressed, else "".
    """
    axes = {code: device.absinfo(code).value for code in gamepad.STICKS}
    return pad.restore(device.active_keys(), axes)


def _drive(
    hear: Callable[[Teleop], Any],
    speed: Callable[[], float],
    way_out: RecoveryKeys,
    note: Callable[[], str] = lambda: "",
) -> None:
    """Forward velocities until Ctrl-C, and end with zero in any case.

    `note` precedes the state of the robot.
    """
    console = Console(markup=False, soft_wrap=True)
    with StopSignals() as signals, Session("teleop") as session:
        teleop = Teleop(session)
        teleop.wait_for_robot()
        try:
            with console.status("") as status:
                while not signals.received:
                    teleop.serve_period(hear(teleop))
                    status.update(Text(note() + teleop.status_line(speed(), way_out)))
        finally:
            teleop.send_zero()


def _pending_input() -> str:
    """Return the unread input of the terminal."""
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    return os.read(sys.stdin.fileno(), 1024).decode(errors="replace") if ready else ""


@contextmanager
def _cbreak_terminal() -> Iterator[None]:
    """Switch the terminal to single keys without echo; Ctrl-C keeps its meaning."""
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    try:
        yield
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _find_gamepad() -> Any:
    """Return the first device with a dead-man's button, or raise ValueError."""
    import evdev

    for path in evdev.list_devices():
        device = evdev.InputDevice(path)
        if gamepad.DEAD_MAN in device.capabilities().get(gamepad.KEY, ()):
            return device
    raise ValueError(
        "no gamepad found in /dev/input: check that it is connected and that you are in the group input"
    )
