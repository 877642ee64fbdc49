"""Simulated control board: a `SimulationLoop` behind the packets of a robot. No ROS.

What all boards share: commands and states pass an unreliable network as packets, which the drives
execute if they are valid. If commands stop, the simulator's watchdog brakes the drives. `udp_board`
and `dds_board` carry the packets.

A board has no thread of its own. Once per period, the thread of the loop takes the packets that
wait and executes the newest valid command, as a robot's firmware does; older ones are dropped. So
packets that waited during a stall of the machine delay no later command.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from quadvel_description.state import MODE_DAMPING, JointCommand, RobotState
from quadvel_driver.board_state import Battery, BoardState, Remote
from quadvel_driver.calibration import Calibration
from quadvel_driver.packets import CONTENT, JOINTS, WireError
from quadvel_sim.bad_network import BadNetwork, NetworkConfig
from quadvel_sim.loop import SimulationLoop

TEMPERATURE_DEGC = 35
"""Reported temperature of motors and IMU; heating is not simulated."""
_TICK_MODULUS = 2**32


class BoardError(ValueError):
    """The board cannot be reached at its address."""


class BoardFormat(Protocol):
    """Bytes of commands and states: a module such as `quadvel_driver.wire`."""

    def decode_command(self, data: bytes, /) -> JointCommand:
        """Decode a command; raise WireError if it is not a valid one."""

    def commanded_modes(self, data: bytes, /) -> NDArray[Any]:
        """Return the mode of each motor in a command, (12,)."""

    def encode_state(self, state: BoardState, /) -> bytes:
        """Encode a state."""


class Board(ABC):
    """Board of a simulated robot.

    `publish` and `receive` are callbacks of the loop and run in its thread. Set `loop`, and
    `receive` as that of the loop, before the loop runs.

    Attributes:
        loop: The simulation that executes the commands.
        remote: State of the wireless remote that the board reports.
        battery: State of the battery that the board reports; None if its packets have none.
        counts: Number of executed commands (`commands`) and of refused packets, by cause.
        last_refusal: Reason why the latest packet was dropped.
    """

    def __init__(
        self,
        wire: BoardFormat,
        network: NetworkConfig,
        calibration: Calibration,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create a board.

        Args:
            wire: Bytes of commands and states.
            network: Faults of the network between board and client.
            calibration: Joint zeros and IMU mounting errors that the simulated sensors have.
            clock: Returns the present time in s; must not be set back.
        """
        self.loop: SimulationLoop | None = None
        self.remote = Remote()
        self.battery: Battery | None = None
        self.counts: Counter[str] = Counter()
        self.last_refusal = ""
        self._wire = wire
        self._calibration = calibration
        self._clock = clock
        self._inbound, self._outbound = BadNetwork(network, 0), BadNetwork(network, 1)
        self._modes: NDArray[Any] = np.full(JOINTS, MODE_DAMPING)  # of each motor, as last commanded

    def publish(self, state: RobotState, instant: float) -> None:
        """Send a state to the client, if there is one.

        Args:
            state: State of the robot, without calibration errors.
            instant: Time of the state in s. The packets have no field for it, so it is not sent.
        """
        assert self.loop is not None
        if not self._has_client():
            return
        modes = np.full(JOINTS, MODE_DAMPING) if self.loop.simulator.braking else self._modes
        warm = np.full(JOINTS, TEMPERATURE_DEGC)
        reported = self._calibration.as_reported(state)
        packet = self._wire.encode_state(
            BoardState(reported, modes, 0 * warm, warm, TEMPERATURE_DEGC, self.remote, self.battery)
        )
        self._outbound.send(packet, self._clock())
        self._send_states()

    def receive(self) -> JointCommand | None:
        """Take the packets that wait, and send the states that the network has delayed until now.

        Returns:
            The newest valid command, as an answer to the present state; None if there is none.
        """
        now = self._clock()
        for packet in self._received():
            self._inbound.send(packet, now)
        self._send_states()
        for packet in reversed(self._inbound.pop_arrived(now)):
            if (command := self._decode(packet)) is not None:
                return command
        return None

    @abstractmethod
    def close(self) -> None:
        """Close the connection, after the end of the loop."""

    @abstractmethod
    def _has_client(self) -> bool:
        """Return whether anyone receives states."""

    @abstractmethod
    def _received(self) -> list[bytes]:
        """Return the command packets that wait."""

    @abstractmethod
    def _transmit(self, packet: bytes) -> None:
        """Send a state packet; raise OSError if that fails."""

    def _decode(self, packet: bytes) -> JointCommand | None:
        """Return the command of a packet for the drives; None and counted if it is not valid."""
        try:
            command = self._calibration.as_executed(self._wire.decode_command(packet))
            self._modes = self._wire.commanded_modes(packet)
        except ValueError as error:
            about = error.kind if isinstance(error, WireError) else CONTENT
            self._count_dropped(f"wrong_{about.lower()}", str(error))
            return None
        self.counts["commands"] += 1
        return self._as_answer(command)

    def _as_answer(self, command: JointCommand) -> JointCommand:
        """Return a command as an answer to the present state: the packets carry no time stamp."""
        assert self.loop is not None
        command.tick = self.loop.tick % _TICK_MODULUS
        return command

    def _count_dropped(self, name: str, why: str) -> None:
        """Count a dropped packet under `name` and keep the reason."""
        self.counts[name] += 1
        self.last_refusal = why

    def _send_states(self) -> None:
        """Send the states that have passed the outbound network."""
        for packet in self._outbound.pop_arrived(self._clock()):
            try:
                self._transmit(packet)
            except OSError as error:  # the client is gone or full; the next state is sent again
                self._count_dropped("not_sent", f"a state can't be sent: {error}")
