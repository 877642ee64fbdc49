"""`quadvel drive`: command one velocity for a while, then zero, and report the response.

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
from numpy.typing import ArrayLike
from rclpy.exceptions import NameValidationException

from quadvel_description.arrays import Array
from quadvel_msgs.msg import ControllerState, VelocityCommand
from quadvel_nodes.number_text import number_text
from quadvel_nodes.topic_types import all_conflicts

from .operator_commands import MODE_TIMEOUT_S, NO_STATES, RECOVERY_HINT, START_HINT
from .processes import StopSignals
from .session import DISCOVERY_TIMEOUT_S, NotRunningError, Session, not_running

TOO_SLOW = "the command mux takes a velocity within its dead_zone for zero"

PUBLISH_PERIOD_S = 0.05
"""Time between two messages; the command mux drops a source after 0.5 s."""
SETTLING_TIME_S = 0.5
"""Time after the command is in full effect before the measured velocity is averaged."""
READY_MODES = ("stance", "walk")
"""Modes in which a robot may be about to follow velocities."""
READY_TIMEOUT_S = 1.0
"""Time for a robot that just stood up, or was paused, to follow velocities again."""
SAME_TOLERANCE = 1e-3
"""Largest difference of equal commands, m/s or rad/s."""
MAX_ESTIMATES = 10_000
"""Number of estimates for the mean, 50 s."""
TWIST = "geometry_msgs/msg/Twist"
"""Type of the velocity commands."""


class DriveRun:
    """Drives the robot and records its response.

    Args:
        session: The node that it uses.
        signals: Ends the waits on Ctrl-C.
        asked: Commanded vx, vy (m/s), wz (rad/s), body frame.
        topic: Input topic of the command mux.
    """

    def __init__(self, session: Session, signals: StopSignals, asked: ArrayLike, topic: str) -> None:
        self._session, self._signals = session, signals
        self._asked = np.array(asked, float)
        self._topic = topic
        self._publisher = session.node.create_publisher(Twist, topic, 10)
        self._states = session.listen(ControllerState, "controller/state")
        self._commands = session.listen(VelocityCommand, "command")
        self._estimates = session.listen(TwistWithCovarianceStamped, "velocity_estimate", MAX_ESTIMATES)
        self._full_effect: float | None = None  # time since which the command is in full effect, s
        self._in_effect = np.zeros(3)
        self._heard: deque[Any] | None = None  # velocities on the topic, own ones, too
        self._rival = ""  # who else commands the robot

    def wait_for_robot(self) -> str:
        """Wait until the command mux listens and the robot stands.

        Returns:
            Why the robot would not follow a velocity, or "".

        Raises:
            NotRunningError: There is no command mux or no controller.
        """
        if not self._wait(self._publisher.get_subscription_count, DISCOVERY_TIMEOUT_S):
            raise self._no_subscriber()
        if not self._wait(lambda: self._states, DISCOVERY_TIMEOUT_S):
            raise not_running(self._session.node, f"controller/state: no message; {START_HINT}")
        if self._signals.received:
            return ""
        self._wait(lambda: self._states[-1].mode_name != "stand_up", MODE_TIMEOUT_S)
        # After standing up, the controller waits for the mux's zero command; after a pause, for states.
        self._wait(
            lambda: self._states[-1].mode_name not in READY_MODES or not self.refusal(), READY_TIMEOUT_S
        )
        return self.refusal()

    def _no_subscriber(self) -> NotRunningError:
        """Return an error that names another type, or the topics on which somebody takes velocities, if there are any."""
        node, text = self._session.node, f"{self._topic}: no subscriber"
        for conflict in all_conflicts(node):
            if conflict.topic == node.resolve_topic_name(self._topic):
                return NotRunningError(str(conflict))
        taken = [
            topic
            for topic, types in node.get_topic_names_and_types()
            if TWIST in types
            and any(one.topic_type == TWIST for one in node.get_subscriptions_info_by_topic(topic))
        ]
        if taken:
            return NotRunningError(f"{text} for velocities, which are taken on {', '.join(taken)}")
        return not_running(node, f"{text}; {START_HINT}")

    def _wait(self, is_so: Callable[[], Any], seconds: float) -> bool:
        """Spin until the predicate holds or Ctrl-C arrives.

        Returns whether one of them did in time.
        """
        return self._session.spin_until(lambda: self._signals.received or is_so(), seconds)

    def refusal(self) -> str:
        """Explain why the robot does not follow velocities now.

        Returns:
            The reason, or "" if it follows.
        """
        state = self._states[-1]
        if state.mode_name == "fault":
            return f"the robot is in fault: {state.reason}\nonce the cause is gone: {RECOVERY_HINT}"
        if not state.rate_hz:  # over the last second
            return NO_STATES
        return str(state.walk_refusal)

    def send(self) -> None:
        """Publish the velocity, and check whether it is in full effect."""
        if self._heard is None:  # from now on, as it is a subscriber itself
            self._heard = self._session.listen(Twist, self._topic, keep=100)
        self._publisher.publish(_twist(self._asked))
        before, self._in_effect = self._in_effect, twist_to_array(self._states[-1].command)
        steady = np.abs(self._in_effect - before).max() < SAME_TOLERANCE
        followed = self._in_effect.any() == self._asked.any()
        if any(np.abs(twist_to_array(twist) - self._asked).max() > SAME_TOLERANCE for twist in self._heard):
            self._rival = f"another program that publishes {self._topic}, too,"
        elif steady and self._commands and not self._is_part(self._in_effect):
            self._rival = f"'{self._commands[-1].source}'"
        if self._full_effect is None and steady and followed:
            self._full_effect = time.monotonic()
            self._estimates.clear()
        if self._full_effect and time.monotonic() - self._full_effect < SETTLING_TIME_S:
            self._estimates.clear()

    def stop(self) -> None:
        """Publish zero velocity."""
        self._publisher.publish(_twist(np.zeros(3)))

    def report(self) -> int:
        """Print the commanded, the effective and the measured velocity.

        Returns:
            The exit code: 1 if the robot followed another source.
        """
        print(f"commanded  {velocity_text(self._asked)}")
        source = self._other_source()
        if not source and np.abs(self._in_effect - self._asked).max() > SAME_TOLERANCE:
            ramping = "still ramping: the mux limits the acceleration"
            why = "clipped to the limits of mux and policy" if self._full_effect else ramping
            print(f"in effect  {velocity_text(self._in_effect)}, {why}")
        if source:
            is_own = source.strip("'") in self._topic
            print("not followed: " + (TOO_SLOW if is_own else f"{source} commands the robot"))
            return 1
        if self._full_effect and self._estimates:
            velocity = _mean(self._estimates)
            print(f"measured   {velocity_text(velocity)}, mean of {len(self._estimates)} estimates")
        else:
            print("measured   nothing: too short to settle; drive for some seconds more")
        return 0

    def _is_part(self, velocity: Array) -> bool:
        """Whether a velocity (3,) can be what limits leave of the asked one."""
        direction = np.where(self._asked < 0.0, -1.0, 1.0)
        along, longest = direction * velocity, direction * self._asked
        return bool(((along > -SAME_TOLERANCE) & (along < longest + SAME_TOLERANCE)).all())

    def _other_source(self) -> str:
        """Return the source that commands the robot, instead of this one or with it, or ""."""
        if self._rival or not self._commands or not self._asked.any() or self._in_effect.any():
            return self._rival
        return f"'{self._commands[-1].source}'"


def drive(vx: float, vy: float, wz: float, seconds: float, topic: str) -> int:
    """Publish a velocity for some seconds or until Ctrl-C, then zero.

    Args:
        vx: m/s, body frame.
        vy: m/s, body frame.
        wz: rad/s.
        seconds: Duration, s.
        topic: Input topic of the command mux.

    Returns:
        The exit code: 1 if the robot did not follow.

    Raises:
        ValueError: A velocity is not finite, or the topic is no valid name.
    """
    for name, value in {"--vx": vx, "--vy": vy, "--wz": wz, "--seconds": seconds}.items():
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value}, expected a finite number")
    with StopSignals() as signals, Session("drive") as session:
        try:
            robot = DriveRun(session, signals, (vx, vy, wz), topic)
        except NameValidationException as error:
            raise ValueError(f"--topic: {error}") from None
        refusal = robot.wait_for_robot()
        if signals.received:
            return 0
        until = time.monotonic() + seconds
        while not refusal and not signals.received and time.monotonic() < until:
            robot.send()
            session.spin(PUBLISH_PERIOD_S)
            refusal = robot.refusal()
        robot.stop()
        if refusal:
            print(f"not followed: {refusal}")
            return 1
        return robot.report()


def _twist(velocity: Array) -> Any:
    """Convert a velocity (3,) to a Twist."""
    message = Twist()
    message.linear.x, message.linear.y, message.angular.z = velocity.tolist()
    return message


def twist_to_array(twist: Any) -> Array:
    """Convert a geometry_msgs/Twist to an array.

    Args:
        twist: The message; its velocities are in the body frame.

    Returns:
        (3,) vx, vy (m/s), wz (rad/s), body frame.
    """
    return np.array([twist.linear.x, twist.linear.y, twist.angular.z])


def velocity_text(velocity: Array) -> str:
    """Format a planar velocity for people.

    Args:
        velocity: (3,) vx, vy (m/s), wz (rad/s).

    Returns:
        One line with units.
    """
    return "vx {} m/s, vy {} m/s, wz {} rad/s".format(*(number_text(value, "+.2f") for value in velocity))


def _mean(estimates: deque[Any]) -> Array:
    """Return the mean velocity (3,) of estimates."""
    mean: Array = np.mean([twist_to_array(estimate.twist.twist) for estimate in estimates], axis=0)
    return mean
