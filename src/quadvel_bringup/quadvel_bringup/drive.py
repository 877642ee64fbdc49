"""`quadvel drive`: one velocity for a while, then zero, and what came of it.

Needs `rclpy`: ROS 2's own, or the embedded one after `quadvel_dds.install()`.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistWithCovarianceStamped
from numpy.typing import ArrayLike, NDArray

from quadvel_msgs.msg import ControllerState, VelocityCommand
from quadvel_nodes.number_text import number_text

from .operator_commands import CONTROLLER, LONGEST, WAY_OUT
from .processes import StopSignals
from .session import PATIENCE, Session

PERIOD = 0.05  # s, between two messages; the command mux forgets a source after 0.5 s
SETTLING = 0.5  # s after the command is in full effect until the measured velocity counts
SAME = 1e-3  # m/s, rad/s, within which two commands are the same
ESTIMATES = 10_000  # kept for the mean: 50 s of them

Array = NDArray[np.float64]


class Drive:
    """What the robot says while it is driven. asked: vx, vy (m/s), wz (rad/s)."""

    def __init__(self, session: Session, signals: StopSignals, asked: ArrayLike, topic: str) -> None:
        self._session, self._signals = session, signals
        self._asked = np.array(asked, float)
        self._topic = topic
        self._publisher = session.node.create_publisher(Twist, topic, 10)
        self._states = session.listen(ControllerState, "controller/state")
        self._commands = session.listen(VelocityCommand, "command")
        self._estimates = session.listen(TwistWithCovarianceStamped, "velocity_estimate", ESTIMATES)
        self._full_effect: float | None = None  # since when the whole command is in effect, s
        self._in_effect = np.zeros(3)

    def wait_for_robot(self) -> str:
        """Until somebody hears us and the robot stands: why it would not follow, or "". Raises NobodyThere."""
        if not self._wait(self._publisher.get_subscription_count, PATIENCE):
            raise self._session.nobody(f"{self._topic}: nobody listens; {CONTROLLER}")
        if not self._wait(lambda: self._states, PATIENCE):
            raise self._session.nobody(f"controller/state: nothing came; {CONTROLLER}")
        if self._signals.received:
            return ""
        self._wait(lambda: self._states[-1].mode_name != "stand_up", LONGEST)
        # The mux commands zero all the time, which a robot that has just stood up waits for.
        self._wait(lambda: not self._states[-1].walk_refusal, PERIOD * 4)
        return self.refusal()

    def _wait(self, is_so: Callable[[], Any], seconds: float) -> bool:
        """Serve until the predicate holds, or Ctrl-C comes; whether one of them does in time."""
        return self._session.spin_until(lambda: self._signals.received or is_so(), seconds)

    def refusal(self) -> str:
        """Why the robot does not follow velocities now; empty where it does."""
        state = self._states[-1]
        if state.mode_name == "fault":
            return f"the robot is in fault: {state.reason}\nonce the cause is gone: {WAY_OUT}"
        if not state.rate_hz:  # over the last second
            return "the controller hears no robot: is the simulator paused?"
        return str(state.walk_refusal)

    def send(self) -> None:
        """The velocity once more, and note whether all of it is in effect by now."""
        self._publisher.publish(_twist(self._asked))
        before, self._in_effect = self._in_effect, planar(self._states[-1].command)
        steady = np.abs(self._in_effect - before).max() < SAME
        followed = self._in_effect.any() == self._asked.any()
        if self._full_effect is None and steady and followed:
            self._full_effect = time.monotonic()
            self._estimates.clear()
        if self._full_effect and time.monotonic() - self._full_effect < SETTLING:
            self._estimates.clear()

    def stop(self) -> None:
        """Zero."""
        self._publisher.publish(_twist(np.zeros(3)))

    def report(self) -> int:
        """Print what was commanded, what was in effect, what was measured; the exit code."""
        print(f"commanded  {velocity_text(self._asked)}")
        if np.abs(self._in_effect - self._asked).max() > SAME:
            on_its_way = "still on its way: it changes no faster than the mux lets it"
            why = "cut to the limits of mux and policy" if self._full_effect else on_its_way
            print(f"in effect  {velocity_text(self._in_effect)}, {why}")
        if source := self._other_source():
            print(f"not followed: {source} commands the robot")
            return 1
        if self._full_effect and self._estimates:
            velocity = _mean(self._estimates)
            print(f"measured   {velocity_text(velocity)}, mean of {len(self._estimates)} estimates")
        else:
            print("measured   nothing: too short for the robot to settle; drive for some seconds more")
        return 0

    def _other_source(self) -> str:
        """Who commands the robot instead of us, or ""."""
        if not self._commands or not self._asked.any() or self._in_effect.any():
            return ""
        return f"'{self._commands[-1].source}'"


def drive(vx: float, vy: float, wz: float, seconds: float, topic: str) -> int:
    """Publish a Twist (m/s, m/s, rad/s, body frame) for some seconds or until Ctrl-C, then one of zeros.

    Returns the exit code: 1 where the robot did not follow. Raises ValueError for what is no number, NobodyThere.
    """
    for name, value in {"--vx": vx, "--vy": vy, "--wz": wz, "--seconds": seconds}.items():
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value}, expected a finite number")
    with StopSignals() as signals, Session("drive") as session:
        robot = Drive(session, signals, (vx, vy, wz), topic)
        refusal = robot.wait_for_robot()
        if signals.received:
            return 0
        until = time.monotonic() + seconds
        while not refusal and not signals.received and time.monotonic() < until:
            robot.send()
            session.spin(PERIOD)
            refusal = robot.refusal()
        robot.stop()
        if refusal:
            print(f"not followed: {refusal}")
            return 1
        return robot.report()


def _twist(velocity: Array) -> Any:
    message = Twist()
    message.linear.x, message.linear.y, message.angular.z = velocity.tolist()
    return message


def planar(twist: Any) -> Array:
    """vx, vy (m/s) and wz (rad/s) of a geometry_msgs/Twist, (3,)."""
    return np.array([twist.linear.x, twist.linear.y, twist.angular.z])


def velocity_text(velocity: Array) -> str:
    """Such a velocity for people."""
    return "vx {} m/s, vy {} m/s, wz {} rad/s".format(*(number_text(value, "+.2f") for value in velocity))


def _mean(estimates: deque[Any]) -> Array:
    mean: Array = np.mean([planar(estimate.twist.twist) for estimate in estimates], axis=0)
    return mean
