"""Which sockets a process has, as the kernel reports it."""

from __future__ import annotations

import ipaddress
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import attrs

FAMILIES, PROTOCOLS = (socket.AF_INET, socket.AF_INET6), (socket.IPPROTO_TCP, socket.IPPROTO_UDP)
SOCK_DIAG, SOCK_DIAG_BY_FAMILY, REQUEST_ALL, DONE = 4, 20, 0x301, 3  # of linux/netlink.h, sock_diag.h
LISTENING = 10  # TCP_LISTEN of tcp_states.h
ACCEPTS = 0x10000  # __SO_ACCEPTCON of linux/net.h


@attrs.frozen
class Bound:
    """A socket: its address, the interface that it is held to, if it is, and whether it takes connections."""

    address: str
    port: int
    interface: str | None
    listening: bool

    @property
    def of_this_host(self) -> bool:
        return ipaddress.ip_address(self.address).is_loopback or self.interface == "lo"


def all_sockets() -> dict[str, Bound]:
    """Those of IPv4 and IPv6 on this machine, by their inodes, as the kernel reports them by netlink."""
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
            yield f"socket:[{inode}]", Bound(address, port, name, data[17] == LISTENING)
            data = data[length:]


def sockets_of(process: int) -> list[Bound]:
    """Those of one process that reach the network."""
    names = open_files(process)
    return [bound for name, bound in all_sockets().items() if name in names]


def unix_listeners(process: int) -> list[str]:
    """The addresses of the Unix sockets on which one process takes connections; `@` stands before one without a file."""
    names = open_files(process)
    rows = [row.split(maxsplit=7) for row in Path("/proc/net/unix").read_text().splitlines()[1:]]
    return [row[7] for row in rows if int(row[3], 16) & ACCEPTS and f"socket:[{row[6]}]" in names]


def open_files(process: int) -> set[str]:
    """What the descriptors of a process stand for."""
    names = set()
    for descriptor in Path(f"/proc/{process}/fd").glob("*"):
        with suppress(FileNotFoundError):  # closed meanwhile
            names.add(os.readlink(descriptor))
    return names


def family_of(process: int) -> list[int]:
    """A process and all that descend from it."""
    found = [process]
    for parent in found:
        for file in Path(f"/proc/{parent}/task").glob("*/children"):
            with suppress(FileNotFoundError, ProcessLookupError):  # ended meanwhile
                found += map(int, file.read_text().split())
    return found
