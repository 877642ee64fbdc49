"""UDP connection to a board. No ROS.

It moves bytes only; `wire` encodes them, and `link` decides what to send and when.
"""

from __future__ import annotations

import select
import socket
from collections import Counter

import attrs
from typing_extensions import override

from quadvel_description.fields import field, refusal

from .link import LinkConfig, LinkError, Transport


@attrs.frozen(kw_only=True, slots=False)  # for multiple inheritance
class UdpConfig(LinkConfig):
    """Network addresses of board and link.

    Attributes:
        board_address: IP address of the board.
        board_port: UDP port of the board.
        local_address: Local IP address; empty for any.
        local_port: Local UDP port; 0 for any free one.

    Raises:
        ValueError: A number is out of range; raised by the constructor.
    """

    board_address: str = field("192.168.123.10", "IP address of the robot's board")
    board_port: int = field(8007, "UDP port of the board", at_least=1, at_most=65535, whole=True)
    local_address: str = field("", "own IP address to use; empty: the one that reaches the board")
    local_port: int = field(
        8082,
        "own UDP port, to which the board answers; 0: any that is free",
        at_least=0,
        at_most=65535,
        whole=True,
    )

    @board_address.validator
    def _is_given(self, attribute: object, value: str) -> None:
        """Require an address: the operating system takes an empty one for this computer."""
        if not value:
            raise refusal(self, "board_address", value, "the board's IP address")


class UdpTransport(Transport):
    """Socket that is connected to one board: from then on the kernel drops datagrams of others.

    Attributes:
        local_port: Local UDP port.
    """

    def __init__(self, config: UdpConfig) -> None:
        """Open the socket.

        Args:
            config: Addresses.

        Raises:
            LinkError: The socket cannot be opened.
        """
        self.counts: Counter[str] = Counter()
        self.board = f"{config.board_address}:{config.board_port}"
        self._socket = _connect(config)
        self.local_port = int(self._socket.getsockname()[1])

    @override
    def wait(self, timeout: float) -> None:
        select.select([self._socket], [], [], timeout)

    @override
    def receive(self) -> bytes | None:
        while True:
            try:
                data, sender = self._socket.recvfrom(65536)
            except BlockingIOError:
                return None
            if sender == self._socket.getpeername():
                return data
            self.counts["from_others"] += 1  # arrived between bind and connect

    @override
    def send(self, packet: bytes) -> None:
        self._socket.send(packet)

    @override
    def close(self) -> None:
        self._socket.close()


def _connect(config: UdpConfig) -> socket.socket:
    """Return a socket connected to the board; raise LinkError on failure."""
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    local = config.local_address, config.local_port
    try:
        endpoint.setblocking(False)
        if config.interface:
            endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, config.interface.encode())
        endpoint.bind(local)
        endpoint.connect((config.board_address, config.board_port))
    except (OSError, OverflowError) as error:
        endpoint.close()
        own = f"{config.local_address or 'any address'}:{config.local_port}"
        on = f" on {config.interface}" if config.interface else ""
        raise LinkError(
            f"no link from {own}{on} to {config.board_address}:{config.board_port}: {error}; "
            "expected the address of the robot's board (board_address) and a free port here (local_port)"
        ) from error
    return endpoint
