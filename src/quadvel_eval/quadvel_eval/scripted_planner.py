"""The node `planner`: walks the robot through a script with velocities on cmd_vel. `script` holds scripts."""

from __future__ import annotations

from typing import Any

import attrs
from geometry_msgs.msg import Twist
from rclpy.node import Node
from std_msgs.msg import String

from quadvel_msgs.msg import ControllerState
from quadvel_msgs.srv import SetMode
from quadvel_nodes.node import read_parameters, request_exit, run

from .script import SCRIPTS, ScriptError, ScriptRunner, Velocity

PERIOD = 0.02  # s, of cmd_vel


@attrs.frozen
class PlannerParameters:
    """The node's parameters."""

    script: str = attrs.field(
        default="full", metadata={"description": f"which script is walked: {' or '.join(SCRIPTS)}"}
    )

    def __attrs_post_init__(self) -> None:
        if self.script not in SCRIPTS:
            raise ValueError(f"script is {self.script!r}, expected {' or '.join(SCRIPTS)}")


class ScriptedPlanner(Node):
    """Orders modes from the controller and publishes velocities; ends with 0 when the script is through."""

    def __init__(self) -> None:
        super().__init__("planner")
        settings = read_parameters(self, PlannerParameters)
        self._runner = ScriptRunner(SCRIPTS[settings.script])
        self._mode = self._reason = self._step = ""
        self._velocity = self.create_publisher(Twist, "cmd_vel", 10)
        self._announcement = self.create_publisher(String, "planner/step", 10)
        self._set_mode = self.create_client(SetMode, "controller/set_mode")
        self.create_subscription(ControllerState, "controller/state", self._on_state, 10)
        self.create_timer(PERIOD, self._update)

    def _on_state(self, message: Any) -> None:
        """What the controller is in; nothing before it has heard the robot, as it refuses all orders until then."""
        if self._mode or message.rate_hz:
            self._mode, self._reason = message.mode_name, message.reason

    def _update(self) -> None:
        try:
            action = self._runner.update(1e-9 * self.get_clock().now().nanoseconds, self._mode, self._reason)
        except ScriptError as error:
            request_exit(self, f"planner: {error}")
            return
        if action is None:
            request_exit(self)
            return
        if action.step != self._step:
            self._step = action.step
            self._announcement.publish(String(data=action.step))
        if action.order:
            self._order(action.order)
        if action.velocity:
            self._velocity.publish(_twist(action.velocity))

    def _order(self, mode: str) -> None:
        """Ask the controller; its state tells whether it did, and the script asks again where it did not."""
        if self._set_mode.service_is_ready():
            self._set_mode.call_async(SetMode.Request(mode=mode))


def _twist(velocity: Velocity) -> Any:
    message = Twist()
    message.linear.x, message.linear.y, message.angular.z = velocity
    return message


def main(args: list[str] | None = None) -> None:
    """Entry point of the node."""
    run(ScriptedPlanner, args)
