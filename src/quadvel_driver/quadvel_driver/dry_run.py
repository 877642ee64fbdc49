"""Dry run: shows the packets that a link would send, for a check without a robot. No ROS."""

from __future__ import annotations

import socket
from typing import Any

from quadvel_description.robot import KINDS, LEGS

from . import wire

SHOWN_BYTES = 11
"""Header (10 bytes) and mode of the first motor."""


class DryRun(socket.socket):
    """Replacement for the link's socket that keeps the last packet, sends nothing and receives nothing."""

    def __init__(self) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)  # not bound to a port
        self.setblocking(False)
        self._packet = b""
        self._count = 0

    def send(self, data: Any, flags: int = 0) -> int:
        """Keep a packet instead of sending it.

        Args:
            data: The packet.
            flags: Not used.

        Returns:
            Number of bytes "sent".
        """
        self._packet = data
        self._count += 1
        return len(data)

    def summary(self) -> str:
        """Describe the packets since the last call.

        Returns:
            The number of packets and a description of the last one.
        """
        count, self._count = self._count, 0
        if not self._packet:
            return "no packet yet"
        return f"{count} packets would have been sent, the last: {describe_packet(self._packet)}"


def describe_packet(packet: bytes) -> str:
    """Describe a command packet: its first and last bytes, and one line per leg.

    Angles (rad) are those of the drives: joint angle plus `joint_zeros` of the calibration, clamped
    for the board. Speeds are in rad/s, torques in N m.

    Args:
        packet: A packet of `wire.encode_command`.

    Returns:
        Several lines of text.
    """
    command = wire.decode_command(packet)
    lines = [
        f"{len(packet)} bytes, {packet[:SHOWN_BYTES].hex()} ... CRC 0x{int.from_bytes(packet[-4:], 'little'):08X}"
    ]
    for leg, name in enumerate(LEGS):
        joints = []
        for i, kind in enumerate(KINDS, start=len(KINDS) * leg):
            law = f"q {command.q[i]:+.3f} dq {command.dq[i]:+.2f} tau {command.tau[i]:+.2f}"
            joints.append(f"{kind} {law} kp {command.kp[i]:g} kd {command.kd[i]:g}")
        lines.append(f"  {name}: {'; '.join(joints)}")
    return "\n".join(lines)
