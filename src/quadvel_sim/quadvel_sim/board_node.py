"""ROS node `board`: the simulated robot behind the interface of an AlienGo (UDP) or a Go2 (DDS).

States and commands use this interface only. The ROS side offers the ground truth, the services of the
simulation, and the topic `~/remote`. A joystick on that topic replaces the wireless remote: axes
lx, ly, rx, ry (-1 to 1), and the buttons in the order of their bits in the protocol.
"""

from __future__ import annotations

from typing import Any

from sensor_msgs.msg import Joy
from typing_extensions import override

from quadvel_description.robot import load_robot
from quadvel_description.state import RobotState
from quadvel_driver.board_state import Button, Remote
from quadvel_driver.unitree_dds.bus import Bus
from quadvel_nodes.node import run
from quadvel_nodes.number_text import counted
from quadvel_sim.board import Board
from quadvel_sim.dds_board import DdsBoard
from quadvel_sim.loop import LoopReport
from quadvel_sim.parameters import BoardParameters
from quadvel_sim.simulation_node import SimulationNode
from quadvel_sim.udp_board import UdpBoard

STICK_AXES = ("lx", "ly", "rx", "ry")


class BoardNode(SimulationNode[BoardParameters]):
    """ROS node of a simulated robot that exchanges the packets of the real one."""

    def __init__(self) -> None:
        """Start the board and the simulation."""
        super().__init__("board", BoardParameters)
        settings = self._settings
        self._board = make_board(settings)
        self._board.loop, self._loop.receive = self._loop, self._board.receive
        self._refused_before = 0
        self.create_subscription(Joy, "~/remote", self._on_remote, 10)
        self.start()

    def destroy_node(self) -> None:
        """Stop the simulation and the node, then close the board's connection."""
        super().destroy_node()
        self._board.close()

    @override
    def publish_sample(self, state: RobotState, instant: float, view_is_due: bool) -> None:
        self._board.publish(state, instant)

    @override
    def diagnostic_values(self) -> dict[str, object]:
        return {**self._board.counts, "last_refusal": self._board.last_refusal}

    @override
    def warning_text(self, report: LoopReport) -> str:
        refused = sum(count for name, count in self._board.counts.items() if name != "commands")
        new, self._refused_before = refused - self._refused_before, refused
        if not new:
            return ""
        return f"{counted(new, 'packet')} dropped in the last second, the last: {self._board.last_refusal}"

    def _on_remote(self, message: Any) -> None:
        """Use axes and buttons of a joystick as the state of the wireless remote."""
        axes, buttons = [*message.axes, 0.0, 0.0, 0.0, 0.0], message.buttons[: len(Button)]
        pressed = sum(bit for bit, is_down in zip(Button, buttons, strict=False) if is_down)
        self._board.remote = Remote(Button(pressed), **dict(zip(STICK_AXES, axes, strict=False)))


def make_board(settings: BoardParameters) -> Board:
    """Create the board of a kind of robot.

    Args:
        settings: Kind of robot, addresses, faults of network and sensors.

    Returns:
        The board, without a simulation.

    Raises:
        ValueError: The address cannot be used, or the robot has no board that is known here.
    """
    if load_robot(settings.robot).require_board() == "unitree_dds":
        return DdsBoard(Bus(settings.dds_domain, settings.interface), settings, settings.calibration())
    return UdpBoard((settings.address, settings.port), settings, settings.calibration())


def main(args: list[str] | None = None) -> None:
    """Run the node `board`.

    Args:
        args: Command line arguments, those of ROS included; None: `sys.argv`.
    """
    run(BoardNode, args)
