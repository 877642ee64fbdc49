"""Simulated control board: a `SimulationLoop` behind the AlienGo's UDP protocol. No ROS.

The board serves one client at a time. The first sender becomes the client; after `CLIENT_TIMEOUT_S`
of silence another sender may take its place. If commands stop, the simulator's watchdog brakes the
drives.
"""

from __future__ import annotations

import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from quadvel_description.state import MODE_DAMPING, RobotState
from quadvel_driver import wire
from quadvel_driver.calibration import Calibration
from quadvel_driver.link import NO_CALIBRATION
from quadvel_driver.wire import JOINTS, BoardState, Remote, WireError
from quadvel_sim.bad_network import BadNetwork, NetworkConfig
from quadvel_sim.loop import SimulationLoop

CLIENT_TIMEOUT_S = 1.0
"""Silence in s after which the board accepts another client."""
STOP_POLL_PERIOD_S = 0.1
"""Longest wait in s between two checks whether the board must stop."""
TEMPERATURE_DEGC = 35
"""Reported temperature of motors and IMU; heating is not simulated."""
MAX_DATAGRAMS_PER_READ = 256
_TICK_MODULUS = 2**32
Address = tuple[str, int]


class BoardError(ValueError):
    """The board cannot listen on its address."""


class Board:
    """UDP side of a simulated robot.

    Set `loop` before `run` is called. `publish` is the callback of the loop and runs in its thread;
    `run` needs a thread for itself.

    Attributes:
        loop: The simulation that executes the commands.
        remote: State of the wireless remote that the board reports to the client.
        counts: Number of executed commands (`commands`) and of dropped datagrams, by cause.
        last_refusal: Reason why the latest datagram was dropped.
    """

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
        self.loop: SimulationLoop | None = None
        self.remote = Remote()
        self.counts: Counter[str] = Counter()
        self.last_refusal = ""
        self._calibration = calibration
        self._clock = clock
        self._socket = _bind_socket(address)
        self._inbound, self._outbound = BadNetwork(network, 0), BadNetwork(network, 1)
        self._lock = threading.Lock()  # guards outbound network and client
        self._client: Address | None = None
        self._modes = np.full(JOINTS, MODE_DAMPING)  # of each motor, as last commanded
        self._last_heard = 0.0
        self._is_stopped = False

    @property
    def address(self) -> Address:
        """IP address and UDP port that the board listens on."""
        host, port = self._socket.getsockname()
        return host, port

    def publish(self, state: RobotState, instant: float) -> None:
        """Send a state to the client, if there is one.

        Args:
            state: State of the robot, without calibration errors.
            instant: Time of the state in s. The UDP protocol has no field for it, so it is not
                sent.
        """
        assert self.loop is not None
        if self._client is None:
            return
        modes = np.full(JOINTS, MODE_DAMPING) if self.loop.simulator.braking else self._modes
        warm = np.full(JOINTS, TEMPERATURE_DEGC)
        packet = wire.encode_state(
            BoardState(
                self._calibration.as_reported(state), modes, 0 * warm, warm, TEMPERATURE_DEGC, self.remote
            )
        )
        with self._lock:
            self._outbound.send(packet, self._clock())
        self._send_states()

    def run(self) -> None:
        """Receive and execute commands until `stop` is called, then close the socket."""
        try:
            while not self._is_stopped:
                select.select([self._socket], [], [], self._poll_timeout())
                self._receive()
                for packet in self._inbound.pop_arrived(self._clock()):
                    self._execute(packet)
                self._send_states()
        finally:
            self._socket.close()

    def stop(self) -> None:
        """Make `run` return; may be called from any thread."""
        self._is_stopped = True

    def _poll_timeout(self) -> float:
        """Return the time in s until the next packet arrives, at most `STOP_POLL_PERIOD_S`."""
        with self._lock:
            soonest = min(self._inbound.next_arrival, self._outbound.next_arrival)
        return min(max(soonest - self._clock(), 0.0), STOP_POLL_PERIOD_S)

    def _receive(self) -> None:
        """Pass datagrams of the client to the inbound network; select a client if there is none."""
        for _ in range(MAX_DATAGRAMS_PER_READ):
            try:
                data, sender = self._socket.recvfrom(65536)
            except BlockingIOError:
                return
            except OSError:  # the client is gone
                continue
            now = self._clock()
            with self._lock:
                if self._client is None or now - self._last_heard > CLIENT_TIMEOUT_S:
                    self._client = sender
                if sender != self._client:
                    self._count_dropped(
                        "from_others",
                        f"{_address_text(sender)} is not served, as {_address_text(self._client)} is",
                    )
                    continue
                self._last_heard = now
            self._inbound.send(data, now)

    def _execute(self, packet: bytes) -> None:
        """Execute a command packet now: the protocol carries no time stamp."""
        assert self.loop is not None
        try:
            command = self._calibration.as_executed(wire.decode_command(packet))
            command.tick = self.loop.tick % _TICK_MODULUS
            self.loop.submit(command)
            self._modes = wire.commanded_modes(packet)
            self.counts["commands"] += 1
        except ValueError as error:
            about = error.kind if isinstance(error, WireError) else wire.CONTENT
            self._count_dropped(f"wrong_{about.lower()}", str(error))

    def _count_dropped(self, name: str, why: str) -> None:
        """Count a dropped datagram under `name` and keep the reason."""
        self.counts[name] += 1
        self.last_refusal = why

    def _send_states(self) -> None:
        """Send the states that have passed the outbound network to the client."""
        with self._lock:
            client = self._client
            if client is None or self._is_stopped:
                return
            for packet in self._outbound.pop_arrived(self._clock()):
                try:
                    self._socket.sendto(packet, client)
                except OSError as error:  # the client is gone or full; the next state is sent again
                    self._count_dropped(
                        "not_sent", f"nothing can be sent to {_address_text(client)}: {error.strerror}"
                    )


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
