"""The robot's board, simulated: a `SimulationLoop` behind the AlienGo's packets on UDP. No ROS.

It answers whoever sends it something first, at the port from which that came, and nobody else until that client has been
silent for a while. The drives brake by themselves where commands stop; that watchdog is the simulator's.
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

PATIENCE = 1.0  # s of silence after which a client is forgotten
LOOK = 0.1  # s, from one look whether it is to end to the next
WARM = 35  # deg C, of motors and IMU: nothing here heats up
MAX_DATAGRAMS = 256  # taken in at once
_WRAP = 2**32
Address = tuple[str, int]


class BoardError(ValueError):
    """Why there can be no board, in one sentence."""


class Board:
    """The UDP side of a simulated robot; `loop` is set before it runs.

    `publish` is the loop's callback and runs in its thread, `run` in one of its own. remote: what the robot reports of
    its wireless remote. counts: of commands that were taken, and of datagrams that were not.
    """

    def __init__(
        self,
        address: Address,
        network: NetworkConfig,
        off: Calibration = NO_CALIBRATION,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """off: what is off with the robot's sensors."""
        self.loop: SimulationLoop | None = None
        self.remote = Remote()
        self.counts: Counter[str] = Counter()
        self.last_refusal = ""
        self._off = off
        self._clock = clock
        self._socket = _bound(address)
        self._inward, self._outward = BadNetwork(network, 0), BadNetwork(network, 1)
        self._lock = threading.Lock()  # around the outward network and the client
        self._client: Address | None = None
        self._modes = np.full(JOINTS, MODE_DAMPING)  # that the last command asked each motor for
        self._heard_at = 0.0
        self._ended = False

    @property
    def address(self) -> Address:
        """Where it listens."""
        host, port = self._socket.getsockname()
        return host, port

    def publish(self, state: RobotState, instant: float) -> None:
        """Send a state to the client, if there is one."""
        assert self.loop is not None
        if self._client is None:
            return
        modes = np.full(JOINTS, MODE_DAMPING) if self.loop.simulator.braking else self._modes
        warm = np.full(JOINTS, WARM)
        packet = wire.encode_state(
            BoardState(self._off.as_reported(state), modes, 0 * warm, warm, WARM, self.remote)
        )
        with self._lock:
            self._outward.send(packet, self._clock())
        self._deliver()

    def run(self) -> None:
        """Take in commands until `stop`."""
        try:
            while not self._ended:
                select.select([self._socket], [], [], self._until_arrival())
                self._receive()
                for packet in self._inward.arrived(self._clock()):
                    self._take(packet)
                self._deliver()
        finally:
            self._socket.close()

    def stop(self) -> None:
        """End `run`."""
        self._ended = True

    def _until_arrival(self) -> float:
        """How long nothing arrives that is under way, s; at most until the next look whether it is to end."""
        with self._lock:
            soonest = min(self._inward.next, self._outward.next)
        return min(max(soonest - self._clock(), 0.0), LOOK)

    def _receive(self) -> None:
        """Put all that has come from the client onto the inward network; who comes first is it."""
        for _ in range(MAX_DATAGRAMS):
            try:
                data, sender = self._socket.recvfrom(65536)
            except BlockingIOError:
                return
            except OSError:  # the client is gone
                continue
            now = self._clock()
            with self._lock:
                if self._client is None or now - self._heard_at > PATIENCE:
                    self._client = sender
                if sender != self._client:
                    self._refuse("from_others", f"{_name(sender)} is not served, as {_name(self._client)} is")
                    continue
                self._heard_at = now
            self._inward.send(data, now)

    def _take(self, packet: bytes) -> None:
        """Carry out a command, as of now: packets have no time."""
        assert self.loop is not None
        try:
            command = self._off.as_executed(wire.decode_command(packet))
            command.tick = self.loop.tick % _WRAP
            self.loop.submit(command)
            self._modes = wire.commanded_modes(packet)
            self.counts["commands"] += 1
        except ValueError as error:
            about = error.kind if isinstance(error, WireError) else wire.CONTENT
            self._refuse(f"wrong_{about.lower()}", str(error))

    def _refuse(self, name: str, why: str) -> None:
        """Count a datagram that could not be used, under a name, and remember why."""
        self.counts[name] += 1
        self.last_refusal = why

    def _deliver(self) -> None:
        """Hand the client the states that have arrived."""
        with self._lock:
            client = self._client
            if client is None or self._ended:
                return
            for packet in self._outward.arrived(self._clock()):
                try:
                    self._socket.sendto(packet, client)
                except OSError as error:  # it is gone, or takes nothing in; the next one goes to it again
                    self._refuse("not_sent", f"nothing can be sent to {_name(client)}: {error.strerror}")


def _name(address: Address) -> str:
    return f"{address[0]}:{address[1]}"


def _bound(address: Address) -> socket.socket:
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    endpoint.setblocking(False)
    try:
        endpoint.bind(address)
    except (OSError, OverflowError) as error:
        endpoint.close()
        raise BoardError(f"the board can't listen on {address[0]}:{address[1]}: {error}") from error
    return endpoint
