"""The node `board`: the simulated robot behind the AlienGo's own UDP interface, for the real driver.

States and commands go over UDP alone. ROS sees the ground truth, the services of the simulation, and `~/remote`, with which
a joystick takes the place of the wireless remote: axes lx, ly, rx, ry, and the buttons in the order of their bits there.
"""

from __future__ import annotations

from threading import Thread
from typing import Any

from sensor_msgs.msg import Joy

from quadvel_description.state import RobotState
from quadvel_driver.wire import Button, Remote
from quadvel_nodes.node import run
from quadvel_sim.board import Board
from quadvel_sim.loop import LoopReport
from quadvel_sim.parameters import BoardParameters
from quadvel_sim.simulation_node import SimulationNode

STICKS = ("lx", "ly", "rx", "ry")


class BoardNode(SimulationNode[BoardParameters]):
    """A simulated robot behind a UDP port."""

    def __init__(self) -> None:
        super().__init__("board", BoardParameters)
        settings = self._settings
        self._board = Board((settings.address, settings.port), settings, settings.off())
        self._board.loop = self._loop
        self._refused_before = 0
        self._network = Thread(target=self._board.run, name="network")
        self.create_subscription(Joy, "~/remote", self._on_remote, 10)
        self._network.start()
        self.begin()

    def destroy_node(self) -> None:
        """Stop the network, the simulation, then the node."""
        self._board.stop()
        self._network.join()
        super().destroy_node()

    def publish_sample(self, state: RobotState, instant: float, view: bool) -> None:
        """The state to the client."""
        self._board.publish(state, instant)

    def figures(self) -> dict[str, object]:
        """What came over the network."""
        return {**self._board.counts, "last_refusal": self._board.last_refusal}

    def worry(self, report: LoopReport) -> str:
        """Whether datagrams could not be used."""
        refused = sum(count for name, count in self._board.counts.items() if name != "commands")
        new, self._refused_before = refused - self._refused_before, refused
        return f"{new} datagrams dropped in the last second: {self._board.last_refusal}" if new else ""

    def _on_remote(self, message: Any) -> None:
        axes, buttons = [*message.axes, 0.0, 0.0, 0.0, 0.0], message.buttons[: len(Button)]
        held = sum(bit for bit, down in zip(Button, buttons, strict=False) if down)
        self._board.remote = Remote(Button(held), **dict(zip(STICKS, axes, strict=False)))


def main(args: list[str] | None = None) -> None:
    """Entry point of the node."""
    run(BoardNode, args)
