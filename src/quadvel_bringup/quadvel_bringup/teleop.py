"""`quadvel teleop`: drive the robot by the keys of a terminal, or by a gamepad.

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
from typing import Any

import attrs
import numpy as np
from geometry_msgs.msg import Twist
from rich.console import Console
from rich.markup import escape

from quadvel_msgs.msg import ControllerState
from quadvel_msgs.srv import SetMode
from quadvel_view import gamepad, keyboard
from quadvel_view.gamepad import Gamepad, Span
from quadvel_view.keyboard import Keyboard, strokes
from quadvel_view.operator import PERIOD, Operator

from .drive import planar, velocity_text
from .operator_commands import CONTROLLER
from .processes import StopSignals
from .session import PATIENCE, Session

ORDERS = {"u": "stand_up", "x": "lie_down"}
HAND = "hand"
SILENT = f"gamepad silent for {gamepad.SILENCE:g} s: press the dead-man's button again   "


@attrs.frozen
class WayOut:
    """What a hand presses: release, to release the STOP; recover, to stand up again after a fault."""

    release: str
    recover: str


KEYS = WayOut(release="r", recover="space, r, then u")
BUTTONS = WayOut(release="start", recover="B, start, then `quadvel mode stand_up`")


def state_line(state: Any, stopped: bool, speed: float, way_out: WayOut) -> str:
    """The robot in one line.

    Args:
        state: the last ControllerState.
        stopped: whether STOP is pressed.
        speed: m/s, straight on, of what is held.
        way_out: of the hand that drives.
    """
    stop = f"STOPPED, {way_out.release} releases   " if stopped else ""
    if state.mode_name == "fault":
        return f"{stop}fault: {state.reason}   once the cause is gone: {way_out.recover}"
    return f"{stop}{state.mode_name}   speed {speed:.1f} m/s   {velocity_text(planar(state.command))}"


class Teleop:
    """What is said to the robot, and what it says."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._operator = Operator()
        self._publisher = session.node.create_publisher(Twist, "cmd_vel_teleop", 10)
        self._states = session.listen(ControllerState, "controller/state")
        self._set_mode = session.node.create_client(SetMode, "controller/set_mode")
        self._asked = 0.0

    def wait_for_robot(self) -> None:
        """Raises NobodyThere where no robot is heard."""
        if not self._session.spin_until(lambda: self._states and self._set_mode.service_is_ready(), PATIENCE):
            raise self._session.nobody(f"controller/state: nothing came; {CONTROLLER}")

    def order(self, order: str) -> None:
        """ "stop", "release", or a mode, of which none counts while STOP is pressed."""
        if order == "stop":
            self._operator.stop()
            self._ask("passive")
        elif order == "release":
            self._operator.release()
        elif order and not self._operator.stopped:
            self._ask(order)

    def serve(self, velocity: Any) -> None:
        """One period: the velocity that is held, or None."""
        now = time.monotonic()
        if velocity is None:
            self._operator.let_go(HAND, now)
        else:
            self._operator.hold(HAND, velocity, now)
        self._publish(self._operator.velocity(now))
        mode = self._states[-1].mode_name if self._states else ""
        if self._operator.is_unheeded(mode, now - self._asked):
            self._ask("passive")
        self._session.spin(PERIOD)

    def line(self, speed: float, way_out: WayOut) -> str:
        """`state_line` of the robot as it is now."""
        return state_line(self._states[-1], self._operator.stopped, speed, way_out)

    def end(self) -> None:
        """Zero, as the last word."""
        self._publish(np.zeros(3))

    def _publish(self, velocity: Any) -> None:
        if velocity is not None:
            twist = Twist()
            twist.linear.x, twist.linear.y, twist.angular.z = velocity.tolist()
            self._publisher.publish(twist)

    def _ask(self, mode: str) -> None:
        self._asked = time.monotonic()
        self._set_mode.call_async(SetMode.Request(mode=mode))


def by_keyboard() -> int:
    """Until Ctrl-C. Raises ValueError where standard input is no terminal, NobodyThere where no robot is heard."""
    if not sys.stdin.isatty():
        raise ValueError("keys come from a terminal, and standard input is none")
    keys = Keyboard()

    def hear(teleop: Teleop) -> Any:
        for key in strokes(_typed()):
            if key in (" ", "r"):
                keys.let_go()
                teleop.order("stop" if key == " " else "release")
            elif key in ORDERS:
                teleop.order(ORDERS[key])
            keys.stroke(key, time.monotonic())
        return keys.velocity(time.monotonic())

    print("".join(str(keyboard.__doc__).partition("\n\n")[1:]).strip("\n"))
    with _keys_as_they_come():
        _drive(hear, lambda: keys.speed, KEYS)
    return 0


def by_gamepad() -> int:
    """Until Ctrl-C. Raises ValueError where there is none, or it is pulled out; NobodyThere where no robot is heard."""
    device = _find_gamepad()
    spans = {code: Span(info.min, info.max) for code, info in device.capabilities()[gamepad.ABSOLUTE]}
    pad = Gamepad(spans)

    def hear(teleop: Teleop) -> Any:
        try:
            while (event := device.read_one()) is not None:
                order = pad.follow(event.type, event.code, event.value)
                teleop.order(restore(pad, device) if order == "restore" else order)
        except OSError:
            raise ValueError(f"{device.name}: the gamepad is gone") from None
        return pad.velocity()

    print("".join(str(gamepad.__doc__).partition("\n\n")[1:]).strip("\n"))
    print(f"by {device.name}")
    _drive(hear, lambda: pad.speed, BUTTONS, lambda: SILENT if pad.fell_silent else "")
    return 0


def restore(pad: Gamepad, device: Any) -> str:
    """Ask an evdev device what is held, after the kernel has lost events of it; "stop" where STOP is."""
    axes = {code: device.absinfo(code).value for code in gamepad.STICKS}
    return pad.restore(device.active_keys(), axes)


def _drive(
    hear: Callable[[Teleop], Any],
    speed: Callable[[], float],
    way_out: WayOut,
    note: Callable[[], str] = lambda: "",
) -> None:
    """Hand on what is heard until Ctrl-C; the last word is zero, whatever happens. note: shown before the robot's state."""
    console = Console(soft_wrap=True)
    with StopSignals() as signals, Session("teleop") as session:
        teleop = Teleop(session)
        teleop.wait_for_robot()
        try:
            with console.status("") as status:
                while not signals.received:
                    teleop.serve(hear(teleop))
                    status.update(escape(note() + teleop.line(speed(), way_out)))
        finally:
            teleop.end()


def _typed() -> str:
    """What waits at the terminal."""
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    return os.read(sys.stdin.fileno(), 1024).decode(errors="replace") if ready else ""


@contextmanager
def _keys_as_they_come() -> Iterator[None]:
    """While entered, the terminal sends each key at once and does not show it; Ctrl-C stays what it is."""
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    try:
        yield
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _find_gamepad() -> Any:
    """The first device with a dead-man's button and sticks. Raises ValueError."""
    import evdev

    for path in evdev.list_devices():
        device = evdev.InputDevice(path)
        if gamepad.DEAD_MAN in device.capabilities().get(gamepad.KEY, ()):
            return device
    raise ValueError(
        "no gamepad was found in /dev/input; is it plugged in, and may you read it (group input)?"
    )
