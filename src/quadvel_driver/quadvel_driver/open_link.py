"""Which link a robot needs: its packets, connection and takeover. No ROS.

`driver` asks for the link. `link` decides what is sent and when; `udp` and `unitree_dds` transport
it.
"""

from __future__ import annotations

from collections.abc import Callable

import attrs

from quadvel_description.robot import Robot, load_robot

from . import wire
from .board_state import BoardState
from .dry_run import DryRun
from .link import Link, WireFormat
from .parameters import DriverParameters
from .udp import UdpTransport
from .unitree_dds import wire as dds_wire
from .unitree_dds.bus import Bus
from .unitree_dds.motion_switcher import MotionSwitcher
from .unitree_dds.takeover import DdsTakeover
from .unitree_dds.transport import DdsTransport


@attrs.frozen
class OpenLink:
    """A link and what it was made of.

    Attributes:
        link: The link, not yet running.
        robot: The robot.
        board: Name of the board, for messages.
        dry_run: The connection if nothing is sent, else None.
    """

    link: Link
    robot: Robot
    board: str
    dry_run: DryRun | None


def open_link(settings: DriverParameters, on_state: Callable[[BoardState], None]) -> OpenLink:
    """Open the link to the robot of the parameters.

    Args:
        settings: Robot, addresses, calibration.
        on_state: See `Link`.

    Returns:
        The link.

    Raises:
        LinkError: The connection cannot be opened.
        FileNotFoundError: There is no such robot.
        ValueError: The robot has no board that is known here.
        CalibrationError: The calibration file cannot be used.
    """
    calibration = settings.load_calibration()
    robot = load_robot(settings.robot)
    uses_dds = robot.require_board() == "unitree_dds"
    packets: WireFormat = dds_wire if uses_dds else wire
    if settings.dry_run:
        dry_run = DryRun(robot, packets)
        link = Link(robot, packets, dry_run, settings, on_state, calibration)
        return OpenLink(link, robot, dry_run.board, dry_run)
    if not uses_dds:
        udp = UdpTransport(settings)
        link = Link(robot, packets, udp, settings, on_state, calibration)
        return OpenLink(link, robot, udp.board, None)
    bus = Bus(settings.dds_domain, settings.interface)
    dds = DdsTransport(bus)
    takeover = DdsTakeover(dds, MotionSwitcher(bus), settings.min_battery)
    link = Link(robot, packets, dds, settings, on_state, calibration, takeover)
    return OpenLink(link, robot, dds.board, None)
