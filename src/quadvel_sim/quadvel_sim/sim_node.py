"""ROS node `sim_node`: offers the simulated robot through the topics of the real one.

Its base `SimulationNode` publishes the ground truth and has the services.
"""

from __future__ import annotations

from collections.abc import Callable

from rosgraph_msgs.msg import Clock as ClockMessage
from typing_extensions import override

from quadvel_description.state import RobotState
from quadvel_msgs.msg import LowCmd, LowState, Waiting
from quadvel_nodes.flat_messages import decode_low_cmd, encode_low_state
from quadvel_nodes.messages import Refusals
from quadvel_nodes.node import run
from quadvel_nodes.robot_view import RobotView
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.loop import REALTIME, LoopReport
from quadvel_sim.parameters import SimParameters
from quadvel_sim.simulation_node import SimulationNode
from quadvel_sim.simulator import Simulator


class SimNode(SimulationNode[SimParameters]):
    """ROS node that answers low_cmd with low_state of a simulated robot."""

    def __init__(self, make_simulator: Callable[[SimulatorConfig], Simulator] = Simulator) -> None:
        """Start the simulation.

        Args:
            make_simulator: Creates the simulator from its configuration; evaluation passes other
                plants.
        """
        super().__init__("sim_node", SimParameters, make_simulator)
        self._refusals = Refusals()
        self._unanswered_before = 0
        self._low_state = self.create_publisher(LowState, "low_state", 10)
        self._waiting = self.create_publisher(Waiting, "waiting", 1)
        self._clock_publisher = self.create_publisher(ClockMessage, "/clock", 10)
        config = self._loop.simulator.config
        noise = config.noise
        self._view = RobotView(
            self, config.robot, noise.orientation, noise.angular_velocity, noise.linear_acceleration
        )
        self.create_subscription(LowCmd, "low_cmd", self._on_command, 10, raw=True)
        self.start()

    @override
    def publish_sample(self, state: RobotState, instant: float, view_is_due: bool) -> None:
        stamp = self.stamp(instant)
        if self._settings.mode != REALTIME:
            self._clock_publisher.publish(ClockMessage(clock=stamp))
        self._low_state.publish(encode_low_state((stamp.sec, stamp.nanosec), state))
        if view_is_due:
            self._view.publish(stamp, state)

    @override
    def publish_waiting(self, tick: int, instant: float) -> None:
        if self.context.ok():
            self._waiting.publish(Waiting(stamp=self.stamp(instant), tick=tick))

    @override
    def diagnostic_values(self) -> dict[str, object]:
        return {**self._refusals.diagnostic_values()}

    @override
    def warning_text(self, report: LoopReport) -> str:
        unanswered = report.unanswered - self._unanswered_before
        self._unanswered_before = report.unanswered
        if refused := self._refusals.last_second():
            return refused
        return "waiting for the LowCmd that answers the last state" if unanswered else ""

    def _on_command(self, data: bytes) -> None:
        """Pass a command to the simulation."""
        try:
            self._loop.submit(decode_low_cmd(data))
        except ValueError as error:
            self._refusals.add("low_cmd", error)


def main(args: list[str] | None = None) -> None:
    """Run the node `sim_node`.

    Args:
        args: Command line arguments, those of ROS included; None: `sys.argv`.
    """
    run(SimNode, args)
