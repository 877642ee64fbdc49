"""Parameters of the node `driver`. Knows no ROS."""

from __future__ import annotations

import attrs

from quadvel_description.fields import field
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_nodes.scheduling import Scheduling

from .calibration import Calibration, CalibrationError
from .link import NO_CALIBRATION
from .remote import RemoteConfig
from .udp import UdpConfig
from .unitree_dds.transport import DdsConfig

MAX_STATE_RATE_HZ = 1000  # rate of the AlienGo's board; that of a Go2 reports at 500 Hz


@attrs.frozen(kw_only=True)
class DriverParameters(UdpConfig, DdsConfig, RemoteConfig, Scheduling):
    """Parameters of link, remote and scheduling, and of the node itself.

    Attributes:
        robot: Name of the robot, or path of a robot.yaml.
        state_rate: Rate of low_state, Hz.
        calibration: Calibration file of this robot; empty for none.
        dry_run: Whether to show packets instead of sending them.
    """

    robot: str = field(DEFAULT_ROBOT, "the robot: its name, or the path of a robot.yaml")
    state_rate: int = field(
        200,
        "rate of low_state, Hz, up to 1000; the board's own is the highest",
        at_least=50,
        at_most=MAX_STATE_RATE_HZ,
        whole=True,
    )
    calibration: str = field("", "file that `quadvel calibrate` wrote of this robot; empty: none")
    dry_run: bool = field(False, "send nothing, hear nothing, and show once a second what would be sent")

    def load_calibration(self) -> Calibration:
        """Load the calibration of the robot.

        Returns:
            The calibration; zero offsets if no file is set.

        Raises:
            CalibrationError: The file is not a calibration of this robot.
            FileNotFoundError: There is no such robot.
        """
        if not self.calibration:
            return NO_CALIBRATION
        found, robot = Calibration.load(self.calibration), load_robot(self.robot).name
        if found.robot != robot:
            raise CalibrationError(f"{self.calibration}: robot is {found.robot!r}, expected {robot!r}")
        return found
