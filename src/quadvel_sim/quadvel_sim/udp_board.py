"""Simulated board behind the AlienGo's UDP protocol. No ROS.

The board serves one client at a time. The first sender becomes the client; after `CLIENT_TIMEOUT_S`
of silence another sender may take its place.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

from typing_extensions import override

from quadvel_driver import wire
from quadvel_driver.calibration import Calibration
from quadvel_driver.link import NO_CALIBRATION
from quadvel_sim.bad_network import NetworkConfig
from quadvel_sim.board import Board, BoardError

CLIENT_TIMEOUT_S = 1.0
"""Silence in s after which the board accepts another client."""
MAX_DATAGRAMS_PER_READ = 256
Address = tuple[str, int]


class UdpBoard(Board):
    """UDP side of a simulated robot."""

    def __init__(
        self,
        address: Address,
        network: NetworkConfig,
        calibration: Calibration = NO_CALIBRATION,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Bind the socket.

        Args:
            address: IP address and UDP port to listen on; port 0 selects a free port.
            network: Faults of the network between client and board.
            calibration: Joint zeros and IMU mounting errors that the simulated sensors have.
            clock: Returns the present time in s; must not be set back.

        Raises:
            BoardError: The address cannot be bound.
        """
        super().__init__(wire, network, calibration, clock)
        self._socket = _bind_socket(address)
        self._client: Address | None = None
        self._last_heard = 0.0

    @property
    def address(self) -> Address:
        """IP address and UDP port that the board listens on."""
        host, port = self._socket.getsockname()
        return host, port

    @override
    def _has_client(self) -> bool:
        return self._client is not None

    @override
    def _received(self) -> list[bytes]:
        """Return the datagrams of the client; select a client if there is none."""
        packets: list[bytes] = []
        for _ in range(MAX_DATAGRAMS_PER_READ):
            try:
                data, sender = self._socket.recvfrom(65536)
            except BlockingIOError:
                break
            except OSError:  # the client is gone
                continue
            if self._is_client(sender):
                packets.append(data)
        return packets

    def _is_client(self, sender: Address) -> bool:
        """Return whether a sender is served; it becomes the client if there is none."""
        now = self._clock()
        if self._client is None or now - self._last_heard > CLIENT_TIMEOUT_S:
            self._client = sender
        if sender != self._client:
            self._count_dropped(
                "from_others", f"{_address_text(sender)} is not served, as {_address_text(self._client)} is"
            )
            return False
        self._last_heard = now
        return True

    @override
    def _transmit(self, packet: bytes) -> None:
        assert self._client is not None
        self._socket.sendto(packet, self._client)

    @override
    def close(self) -> None:
        self._socket.close()


def _address_text(address: Address) -> str:
    return f"{address[0]}:{address[1]}"


def _bind_socket(address: Address) -> socket.socket:
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    endpoint.setblocking(False)
    try:
        endpoint.bind(address)
    except (OSError, OverflowError) as error:
        endpoint.close()
        raise BoardError(f"the board can't listen on {address[0]}:{address[1]}: {error}") from error
    return endpoint
