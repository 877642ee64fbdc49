"""Dry run: shows the packets that a link would send, for a check without a robot. No ROS.

`open_link` puts it in place of the transport; `wire` encodes the packets.
"""

from __future__ import annotations

import time
from collections import Counter

from typing_extensions import override

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot
from quadvel_description.state import MODE_SERVO
from quadvel_nodes.number_text import counted

from .link import Transport, WireFormat

SHOWN_BYTES = 11
"""First bytes of a packet that are shown: header, and for the AlienGo the mode of the first motor."""


class DryRun(Transport):
    """Connection that keeps the last packet, sends nothing and receives nothing."""

    def __init__(self, robot: Robot, wire: WireFormat) -> None:
        """Create a connection to nothing.

        Args:
            robot: Names of the joints.
            wire: Format of the packets.
        """
        self.board, self.counts = "nothing", Counter()
        self._robot, self._wire = robot, wire
        self._packet = b""
        self._count = 0

    @override
    def wait(self, timeout: float) -> None:
        time.sleep(timeout)

    @override
    def receive(self) -> bytes | None:
        return None

    @override
    def send(self, packet: bytes) -> None:
        self._packet = packet
        self._count += 1

    @override
    def close(self) -> None:
        pass

    def summary(self) -> str:
        """Describe the packets since the last call.

        Returns:
            The number of packets and a description of the last one.
        """
        count, self._count = self._count, 0
        if not self._packet:
            return "no packet yet"
        description = describe_packet(self._packet, self._robot, self._wire)
        return f"{counted(count, 'packet')} would have been sent, the last: {description}"


def describe_packet(packet: bytes, robot: Robot, wire: WireFormat) -> str:
    """Describe a command packet: its mode, its first and last bytes, and one line per leg.

    The mode is `servo` if the drives follow targets, and `damping` if they only brake: in the board's
    damping mode, or with kp 0.

    Angles (rad) are those of the drives: joint angle plus `joint_zeros` of the calibration, clamped
    for the board. Speeds are in rad/s, torques in N m.

    Args:
        packet: A packet of `encode_command`.
        robot: Names of the joints.
        wire: Format of the packet.

    Returns:
        Several lines of text.
    """
    command = wire.decode_command(packet)
    mode = "servo" if command.mode == MODE_SERVO and command.kp.any() else "damping"
    crc = int.from_bytes(packet[-4:], "little")
    lines = [f"mode {mode}, {len(packet)} bytes, {packet[:SHOWN_BYTES].hex()} ... CRC 0x{crc:08X}"]
    legs: dict[str, list[str]] = {}
    for i, joint in enumerate(JOINT_NAMES):
        leg, _, kind = joint.removesuffix("_joint").partition("_")
        law = f"q {command.q[i]:+.3f} dq {command.dq[i]:+.2f} tau {command.tau[i]:+.2f}"
        legs.setdefault(leg, []).append(f"{kind} {law} kp {command.kp[i]:g} kd {command.kd[i]:g}")
    lines += [f"  {leg}: {'; '.join(joints)}" for leg, joints in legs.items()]
    return "\n".join(lines)
