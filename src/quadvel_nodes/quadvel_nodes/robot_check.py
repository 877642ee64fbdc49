"""Check that a node and the robot that it serves are the same kind. Needs rclpy."""

from __future__ import annotations

from rclpy.node import Node
from std_msgs.msg import String

from quadvel_description.robot import Robot
from quadvel_description.robot_name import described_robot

from .node import request_exit
from .robot_view import LATCHED


class RobotCheck:
    """Ends a node if `robot_description` is that of another robot.

    Driver and simulator publish the description. A controller or estimator of another robot would
    use wrong lengths, postures and limits.
    """

    def __init__(self, node: Node, robot: Robot) -> None:
        """Subscribe to the description.

        Args:
            node: The node.
            robot: Its robot.
        """
        self._node, self._robot = node, robot
        node.create_subscription(String, "robot_description", self._on_description, LATCHED)

    def _on_description(self, message: String) -> None:
        if found := other_robot(message, self._robot):
            request_exit(
                self._node,
                f"{self._node.get_name()}: robot_description is that of {found!r}, expected "
                f"{self._robot.name!r}: start it with -p robot:={found}",
            )


def other_robot(description: String, robot: Robot) -> str:
    """Return the robot that a description names, if it is another one.

    Args:
        description: Message of `robot_description`.
        robot: The expected robot.

    Returns:
        Its name; "" for the expected robot or none.
    """
    found = described_robot(description.data)
    return "" if found in (None, robot.name) else str(found)
