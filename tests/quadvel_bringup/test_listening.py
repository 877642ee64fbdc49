"""What the nodes listen to: this host alone, unless somebody asked for more."""

from __future__ import annotations

import ipaddress
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import attrs
import pytest

PROGRAM = [sys.executable, "-m", "quadvel_bringup"]
FAMILIES, PROTOCOLS = (socket.AF_INET, socket.AF_INET6), (socket.IPPROTO_TCP, socket.IPPROTO_UDP)
SOCK_DIAG, SOCK_DIAG_BY_FAMILY, REQUEST_ALL, DONE = 4, 20, 0x301, 3  # of linux/netlink.h, sock_diag.h
SOCKETS_OF_DDS = 3  # discovery, data, and the one that sends


@attrs.frozen
class Bound:
    """A socket: its address, and the interface that it is held to, if it is."""

    address: str
    port: int
    interface: str | None

    @property
    def of_this_host(self) -> bool:
        return ipaddress.ip_address(self.address).is_loopback or self.interface == "lo"


def all_sockets() -> dict[str, Bound]:
    """Those of IPv4 and IPv6 on this machine, by their inodes, as the kernel tells who asks by netlink."""
    found = {}
    for family in FAMILIES:
        for protocol in PROTOCOLS:
            with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, SOCK_DIAG) as kernel:
                query = struct.pack("=BBBxI48x", family, protocol, 0, 0xFFFFFFFF)
                kernel.send(
                    struct.pack("=IHHII", 16 + len(query), SOCK_DIAG_BY_FAMILY, REQUEST_ALL, 1, 0) + query
                )
                found.update(answers(kernel))
    return found


def answers(kernel: socket.socket) -> Iterator[tuple[str, Bound]]:
    """Inode and socket out of each inet_diag_msg, up to the end of the answer."""
    while True:
        data = kernel.recv(1 << 20)
        while data:
            length, kind = struct.unpack_from("=IH", data)
            if kind == DONE:
                return
            family = data[16]
            address = socket.inet_ntop(family, data[24 : 24 + (4 if family == socket.AF_INET else 16)])
            (port,), (interface,) = struct.unpack_from(">H", data, 20), struct.unpack_from("=I", data, 56)
            (inode,) = struct.unpack_from("=I", data, 84)
            name = socket.if_indextoname(interface) if interface else None
            yield f"socket:[{inode}]", Bound(address, port, name)
            data = data[length:]


def sockets_of(process: int) -> list[Bound]:
    """Those of one process that reach the network."""
    names = set()
    for descriptor in Path(f"/proc/{process}/fd").glob("*"):
        try:
            names.add(os.readlink(descriptor))
        except FileNotFoundError:
            continue  # closed meanwhile
    return [bound for name, bound in all_sockets().items() if name in names]


def children(process: int) -> list[int]:
    return [int(pid) for pid in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def wait_for(condition, seconds: float = 60.0):
    """What `condition` gives once it is true."""
    until = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < until, "time is up"
        time.sleep(0.2)
    return found


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """The embedded middleware as it is without anything set."""
    unset = ("CYCLONEDDS_URI", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS")
    return {k: v for k, v in os.environ.items() if k not in unset} | {"QUADVEL_MIDDLEWARE": "embedded"}


def test_nothing_of_a_running_robot_can_be_reached_from_another_host(environment: dict[str, str]) -> None:
    up = subprocess.Popen(
        [*PROGRAM, "up", "--low-level", "board"], env=environment, stdout=subprocess.DEVNULL
    )

    def everything() -> dict[int, list[Bound]]:
        """The sockets of all six processes, once there are all of them: board and driver have one more."""
        found = {pid: sockets_of(pid) for pid in (up.pid, *children(up.pid))}
        counts = sorted(len(sockets) for sockets in found.values())
        return found if counts == [SOCKETS_OF_DDS] * 4 + [SOCKETS_OF_DDS + 1] * 2 else {}

    try:
        found = wait_for(everything)
    finally:
        up.send_signal(signal.SIGINT)
        up.wait(30.0)
    open_to_others = [one for sockets in found.values() for one in sockets if not one.of_this_host]
    assert not open_to_others


NODE = """
import quadvel_dds
quadvel_dds.install()
import rclpy
rclpy.init()
node = rclpy.create_node("alone")
node.create_client(__import__("std_srvs.srv", fromlist=["Trigger"]).Trigger, "anything")
print("ready", flush=True)
input()
"""


@pytest.mark.parametrize(
    ("reach", "alone"), [(None, True), ("LOCALHOST", True), ("OFF", True), ("SUBNET", False)]
)
def test_other_hosts_are_heard_where_that_is_asked_for(
    environment: dict[str, str], reach: str | None, alone: bool
) -> None:
    if reach is not None:
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = reach
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", NODE], env=environment, **pipes) as node:
        assert node.stdout is not None
        assert node.stdout.readline() == "ready\n"
        found = sockets_of(node.pid)
        node.communicate("\n")
    assert len(found) > 1
    assert all(one.of_this_host for one in found) == alone
