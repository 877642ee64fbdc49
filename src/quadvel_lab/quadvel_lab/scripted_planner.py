"""Node `planner`: walks the robot through a script with velocities on cmd_vel."""

from __future__ import annotations

import time
from typing import Any

import attrs
from geometry_msgs.msg import Twist
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from quadvel_description.fields import field
from quadvel_eval.script import SCRIPTS, ScriptError, ScriptRunner, Velocity
from quadvel_msgs.msg import ControllerState
from quadvel_msgs.srv import SetMode
from quadvel_nodes.node import read_parameters, request_exit, run

CMD_VEL_PERIOD_S = 0.02
RETRY_INTERVAL_S = 0.5  # from the answer to a request to the next request, while the mode does not change
ANSWER_TIMEOUT_S = (
    3.0  # after which a request counts as lost; a controller without processor time answers late
)


@attrs.frozen
class PlannerParameters:
    """Parameters of the node.

    Attributes:
        script: Name of the script, a key of SCRIPTS.
        wait: Whether the script waits for the service `~/start`.
    """

    script: str = field("full", f"which script is walked: {' or '.join(SCRIPTS)}", one_of=SCRIPTS)
    wait: bool = field(
        False, "whether the script waits for the service ~/start, which a recorder calls when it is ready"
    )


class ScriptedPlanner(Node):
    """Node that requests modes and publishes velocities; it exits with 0 at the end of the script."""

    def __init__(self) -> None:
        super().__init__("planner")
        settings = read_parameters(self, PlannerParameters)
        self._runner = ScriptRunner(SCRIPTS[settings.script])
        self._waits = settings.wait
        self._mode = self._reason = self._walk_refusal = self._step = ""
        self._next_request = 0.0  # earliest time of the next request, s of the monotonic clock
        self._velocity = self.create_publisher(Twist, "cmd_vel", 10)
        self._announcement = self.create_publisher(String, "planner/step", 10)
        self._set_mode = self.create_client(SetMode, "controller/set_mode")
        self.create_subscription(ControllerState, "controller/state", self._on_state, 10)
        self.create_timer(CMD_VEL_PERIOD_S, self._update)
        # The last to be created, so that whoever finds it has found the topics.
        self.create_service(Trigger, "~/start", self._on_start)

    def _on_start(self, _: Any, response: Any) -> Any:
        """Let the script start."""
        self._waits = False
        response.success, response.message = True, "the script runs"
        return response

    def _on_state(self, message: Any) -> None:
        """Store the mode; reports before the first one with a rate do not count, as requests are refused then."""
        if self._mode or message.rate_hz:
            self._mode, self._reason = message.mode_name, message.reason
            self._walk_refusal = message.walk_refusal

    def _update(self) -> None:
        """Execute the next action of the script; end the node at its end or at an error."""
        if self._waits:
            return
        try:
            now = 1e-9 * self.get_clock().now().nanoseconds
            action = self._runner.update(now, self._mode, self._reason, self._walk_refusal)
        except ScriptError as error:
            request_exit(self, f"planner: {error}")
            return
        if action is None:
            request_exit(self)
            return
        if action.step != self._step:
            self._step = action.step
            self._announcement.publish(String(data=action.step))
        if action.requested_mode:
            self._request_mode(action.requested_mode)
        if action.velocity:
            self._velocity.publish(_twist(action.velocity))

    def _request_mode(self, mode: str) -> None:
        """Request a mode, unless an earlier request is on its way or its answer is not visible yet.

        The controller's state shows the answer, and the script repeats its request until then. A request
        that is repeated too early would arrive after the mode has changed, and be refused.
        """
        if time.monotonic() < self._next_request or not self._set_mode.service_is_ready():
            return
        self._next_request = time.monotonic() + ANSWER_TIMEOUT_S
        self._set_mode.call_async(SetMode.Request(mode=mode)).add_done_callback(self._on_answer)

    def _on_answer(self, _: Any) -> None:
        """Allow the next request in a moment: the mode of an accepted one is reported first."""
        self._next_request = time.monotonic() + RETRY_INTERVAL_S


def _twist(velocity: Velocity) -> Any:
    """Twist message of a planar velocity."""
    message = Twist()
    message.linear.x, message.linear.y, message.angular.z = velocity
    return message


def main(args: list[str] | None = None) -> None:
    """Run the node.

    Args:
        args: Command line arguments; None for those of the process.
    """
    run(ScriptedPlanner, args)
