"""Shows what a link would send, to be looked at before a robot is connected. No ROS."""

from __future__ import annotations

import socket
from typing import Any

from quadvel_description.robot import KINDS, LEGS

from . import wire


class DryRun(socket.socket):
    """In place of the link's socket: keeps what it is given, sends nothing, and hears nothing."""

    def __init__(self) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)  # bound to no port
        self.setblocking(False)
        self._packet = b""
        self._count = 0

    def send(self, data: Any, flags: int = 0) -> int:
        """Keep a packet."""
        self._packet = data
        self._count += 1
        return len(data)

    def shown(self) -> str:
        """How many packets came since this was asked last, and the last one in words."""
        count, self._count = self._count, 0
        return f"{count} packets would have been sent, the last: {described(self._packet)}"


def described(packet: bytes) -> str:
    """A command's packet for people: its bytes at both ends, and what it asks of the joints, a line a leg."""
    command = wire.decode_command(packet)
    lines = [
        f"{len(packet)} bytes, {packet[:11].hex()} ... CRC 0x{int.from_bytes(packet[-4:], 'little'):08X}"
    ]
    for leg, name in enumerate(LEGS):
        joints = []
        for i, kind in enumerate(KINDS, start=len(KINDS) * leg):
            law = f"q {command.q[i]:+.3f} dq {command.dq[i]:+.2f} tau {command.tau[i]:+.2f}"
            joints.append(f"{kind} {law} kp {command.kp[i]:g} kd {command.kd[i]:g}")
        lines.append(f"  {name}: {'; '.join(joints)}")
    return "\n".join(lines)
