"""Link to the robot's board: sends commands without a gap and receives the newest state. No ROS.

The link runs in its own thread (`run`). It sends each command immediately and repeats the last one
every 2 ms, so a lost packet costs 2 ms. It sends damping if commands stop, if the operator stops
the robot, and at the end. The board itself brakes if packets stop.

What depends on the robot is passed in: a `Transport` (UDP or DDS) carries packets, a `WireFormat`
gives their bytes, the `Robot` has the limits, and a `Takeover` decides whether anything may be sent.
"""

from __future__ import annotations

import math
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Protocol

import attrs
import numpy as np

from quadvel_description.fields import field, positive
from quadvel_description.robot import Robot
from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand, RobotState
from quadvel_nodes.messages import QUATERNION_TOLERANCE

from .board_clock import BoardClock
from .board_state import BoardState
from .calibration import Calibration
from .packets import CRC, LENGTH, WireError
from .takeover import Access, Takeover

SEND_PERIOD_S = 0.002  # longest time between two packets, as in Unitree's examples
SHUTDOWN_PACKETS = 10  # number of damping packets at the end; some may be lost
MAX_COMMAND_AGE_MS = 100  # largest age of the state that a command answers
MAX_PACKETS = 256  # received per turn, so that a flood cannot block sending
MAX_DECODED = 8  # of them, the newest: more wait only after a stall of the machine
SILENCE_LIMIT_S = 0.1  # time without a new state after which the board counts as silent
_TICK_MODULUS = 2**32


NO_CALIBRATION = Calibration()


class LinkError(ValueError):
    """A link cannot be opened; the text is the reason, in one sentence."""


class WireFormat(Protocol):
    """Bytes of commands and states: a module such as `wire`."""

    def encode_command(self, command: JointCommand, /) -> bytes:
        """Encode a joint command; raise WireError if it cannot be sent."""

    def decode_command(self, data: bytes, /) -> JointCommand:
        """Decode a command; raise WireError if it is not a valid one."""

    def decode_state(self, data: bytes, /) -> BoardState:
        """Decode a packet; raise WireError if it is not a valid state."""


class Transport(ABC):
    """Carries packets between link and board. `send` may be called from any thread.

    Attributes:
        board: Name of the other end, for messages.
        counts: Events since the start: `from_others`, packets of others than the board.
    """

    board: str
    counts: Counter[str]

    @abstractmethod
    def wait(self, timeout: float) -> None:
        """Wait for a packet.

        Args:
            timeout: Longest time, s.
        """

    @abstractmethod
    def receive(self) -> bytes | None:
        """Return the next packet of the board, or None if none waits.

        Returns:
            The packet.

        Raises:
            OSError: The network reports an error; more packets may wait.
        """

    @abstractmethod
    def send(self, packet: bytes) -> None:
        """Send a packet to the board.

        Args:
            packet: The packet.

        Raises:
            OSError: It cannot be sent.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the connection."""


@attrs.frozen(kw_only=True, slots=False)  # for multiple inheritance
class LinkConfig:
    """Network interface and braking of a link.

    Attributes:
        interface: Network interface to use exclusively; empty for any.
        command_timeout: Time without a command after which the link brakes, s.
        damping_kd: Damping gain of braking, N m s/rad.

    Raises:
        ValueError: A number is out of range; raised by the constructor.
    """

    interface: str = field("", "network interface to use alone, such as eth0; empty: any")
    command_timeout: float = positive(
        0.02, "s without a new low_cmd after which the driver brakes the joints", at_most=0.5
    )
    damping_kd: float = positive(5.0, "gain with which it brakes them, N m s/rad", at_most=20.0)


@attrs.frozen
class LinkReport:
    """Status of the link.

    Attributes:
        state_rate: Rate of received states since the last report, Hz.
        send_rate: Rate of sent packets since the last report, Hz.
        silence: Time since the last new state, s; inf before the first one.
        commanded: Whether the board receives commands, not the link's own damping.
        tick_unit: Unit of the board's counter, "ms" or "us"; "" until it is known.
        counter_rate: Rate of the board's counter, counts/s, if it matches neither unit; else None.
        counts: Events since the start, see COUNTER_NAMES.
        last_refusal: Why the last refused datagram was not used.
        last_error: The last network error.
        takeover: Why the link does not fully command the joints, see `Takeover.problem`.
    """

    state_rate: float
    send_rate: float
    silence: float
    commanded: bool
    tick_unit: str
    counter_rate: float | None
    counts: dict[str, int]
    last_refusal: str
    last_error: str
    takeover: str = ""


class Link:
    """Link to one board. All methods except `run` and `serve` may be called from any thread."""

    def __init__(
        self,
        robot: Robot,
        wire: WireFormat,
        transport: Transport,
        config: LinkConfig,
        on_state: Callable[[BoardState], None],
        calibration: Calibration = NO_CALIBRATION,
        takeover: Takeover | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create a link.

        Args:
            robot: Names and limits of the joints.
            wire: Bytes of commands and states.
            transport: Connection to the board; the link closes it.
            config: Braking.
            on_state: Called in the link's thread with each new state; `time` (s) is on `clock`,
                `tick` in ms.
            calibration: Calibration of this robot, which corrects states and commands.
            takeover: Right to command the joints; None for a board that obeys every sender.
            clock: A monotonic clock, s.
        """
        self._robot = robot
        self._wire = wire
        self._transport = transport
        self._config = config
        self._on_state = on_state
        self._calibration = calibration
        self._takeover = takeover or Takeover()
        self._clock = clock
        self._board_clock = BoardClock()
        self._lock = threading.Lock()  # guards the attributes below
        self._damping = self._encode(JointCommand.damping(config.damping_kd))
        self._packet, self._mode = self._damping, MODE_DAMPING
        self._commanded_at = -math.inf
        self._is_braked = self._is_stopped = self._was_fresh = False
        self._send_next = -math.inf
        self._tick = 0
        self._last_state_at = -math.inf
        self._newest: BoardState | None = None
        self._counts: Counter[str] = Counter()
        self._last_refusal = self._last_error = ""
        self._reported_at, self._reported = clock(), Counter[str]()

    def run(self) -> None:
        """Send and receive until `stop` or an error, then brake the robot and close the connection."""
        try:
            while not self._is_stopped:
                self._transport.wait(self._time_until_sending())
                self.serve()
        finally:
            try:
                self._send_shutdown_packets()
            finally:
                self._transport.close()

    def serve(self) -> None:
        """Receive pending packets and send if due; for callers with a clock of their own instead of `run`."""
        self._receive()
        now = self._clock()
        is_silent = now - self._last_state_at > SILENCE_LIMIT_S
        self._takeover.update(now, None if is_silent else self._newest)
        self._send_if_due()

    def stop(self) -> None:
        """Make `run` return."""
        self._is_stopped = True

    def submit(self, command: JointCommand) -> None:
        """Send a command now and repeat it until the next one.

        Args:
            command: The joint command; its `tick` is that of the state it answers.

        Raises:
            ValueError: The command is not finite, too old, or of an unknown mode.
        """
        self._check_age(command.tick)
        packet = self._encode(command)
        with self._lock:
            self._packet, self._mode, self._commanded_at = packet, command.mode, self._clock()
            if not self._is_braked and self._takeover.access is Access.FULL:
                self._send(packet)

    def brake(self) -> None:
        """Brake the joints and ignore commands until `release`."""
        with self._lock:
            self._is_braked = True
            self._send(self._damping)

    def release(self) -> str:
        """Follow commands again, unless a fresh command drives the joints: the robot could jump.

        Returns:
            "" if released, else the reason in one sentence.
        """
        with self._lock:
            if self._is_fresh() and self._mode != MODE_DAMPING:
                return "the controller still drives the joints; it has to be passive first"
            self._is_braked = False
            return ""

    def report(self) -> LinkReport:
        """Report the status since the last report.

        Returns:
            Rates since the last report, counts since the start.
        """
        with self._lock:
            now = self._clock()
            board = self._board_clock
            counts = Counter(self._counts)
            counts.update(self._transport.counts)
            counts.update(repeated=board.repeated, late=board.late, board_restarts=board.restarts)
            elapsed = max(now - self._reported_at, 1e-9)
            rates = {name: (counts[name] - self._reported[name]) / elapsed for name in ("states", "sent")}
            self._reported_at, self._reported = now, counts
            return LinkReport(
                state_rate=rates["states"],
                send_rate=rates["sent"],
                silence=now - self._last_state_at,
                commanded=self._commands_pass(),
                tick_unit="" if board.unit is None else {1e-3: "ms", 1e-6: "us"}[board.unit],
                counter_rate=board.rate,
                counts={name: counts[name] for name in COUNTER_NAMES},
                last_refusal=self._last_refusal,
                last_error=self._last_error,
                takeover=self._takeover.problem,
            )

    # Receiving.

    def _receive(self) -> None:
        """Receive all pending packets and call `on_state` with the newest state."""
        newest = None
        packets = self._packets()
        self._count("superseded", max(len(packets) - MAX_DECODED, 0))
        for packet in packets[-MAX_DECODED:]:
            state = self._accept(packet)
            if state is None:
                continue
            if newest is not None:
                self._count("superseded")
            newest = state
        if newest is not None:
            self._newest = newest
            self._tick, self._last_state_at = newest.robot.tick, self._clock()
            self._count("states")
            self._on_state(newest)

    def _packets(self) -> list[bytes]:
        """Return the pending packets of the board."""
        packets = []
        for _ in range(MAX_PACKETS):
            try:
                packet = self._transport.receive()
            except OSError as error:  # no such port on the board, or the network is down
                self._note_error(error)
                continue
            if packet is None:
                break
            packets.append(packet)
        return packets

    def _accept(self, packet: bytes) -> BoardState | None:
        """Return the state of a packet, or None if it is unusable or not newer."""
        try:
            state = self._wire.decode_state(packet)
            _check_plausible(state.robot)
        except WireError as error:
            self._count({LENGTH: "wrong_length", CRC: "wrong_crc"}.get(error.kind, "unusable"))
            self._last_refusal = str(error)
            return None
        instant = self._board_clock.update(state.robot.tick, self._clock())
        if instant is None:
            return None
        state.robot = attrs.evolve(self._calibration.apply(state.robot), time=instant.time, tick=instant.tick)
        return state

    def _count(self, name: str, events: int = 1) -> None:
        with self._lock:
            self._counts[name] += events

    def _encode(self, command: JointCommand) -> bytes:
        sent = self._calibration.invert(clamp_for_board(command, self._robot))
        return self._wire.encode_command(sent)

    # Sending. Except for `_send_if_due`, `_note_error` and `_send_shutdown_packets`, the caller locks.

    def _time_until_sending(self) -> float:
        return min(max(self._send_next - self._clock(), 0.0), SEND_PERIOD_S)

    def _send_if_due(self) -> None:
        """Repeat the present command if SEND_PERIOD_S has passed; send damping without a fresh command."""
        with self._lock:
            if self._clock() < self._send_next:
                return
            fresh = self._is_fresh()
            if self._was_fresh and not fresh:
                self._counts["command_timeouts"] += 1
            self._was_fresh = fresh
            self._send(self._packet if self._commands_pass() else self._damping)

    def _commands_pass(self) -> bool:
        """Return whether the board receives commands, not the link's own damping."""
        return self._is_fresh() and not self._is_braked and self._takeover.access is Access.FULL

    def _is_fresh(self) -> bool:
        return self._clock() - self._commanded_at <= self._config.command_timeout

    def _send(self, packet: bytes) -> None:
        self._send_next = self._clock() + SEND_PERIOD_S
        if self._takeover.access is Access.NONE:
            return
        try:
            self._transport.send(packet)
            self._counts["sent"] += 1
        except OSError as error:
            self._counts["network_errors"] += 1
            self._last_error = str(error)

    def _send_shutdown_packets(self) -> None:
        for _ in range(SHUTDOWN_PACKETS):
            with self._lock:
                self._send(self._damping)
            time.sleep(SEND_PERIOD_S)

    def _note_error(self, error: OSError) -> None:
        with self._lock:
            self._counts["network_errors"] += 1
            self._last_error = str(error)

    def _check_age(self, tick: int) -> None:
        """Raise ValueError if a command answers a future state or one that is too old."""
        if self._last_state_at == -math.inf:  # in a dry run, the command answers a simulator
            return
        age = (self._tick - tick + _TICK_MODULUS // 2) % _TICK_MODULUS - _TICK_MODULUS // 2  # ms
        if age < 0:
            raise ValueError(f"it answers tick {tick}, which is to come: the newest is {self._tick}")
        if age > MAX_COMMAND_AGE_MS:
            raise ValueError(
                f"it answers tick {tick}, {age} ms ago: expected at most {MAX_COMMAND_AGE_MS} ms"
            )


COUNTER_NAMES = (
    *(
        "states",
        "sent",
        "superseded",
        "repeated",
        "late",
        "wrong_length",
        "wrong_crc",
        "unusable",
        "from_others",
    ),
    *("command_timeouts", "board_restarts", "network_errors"),
)
"""Counts of a report, since the start.

states: passed to `on_state`; sent: packets;
superseded: states replaced by a newer one in the same turn;
repeated, late: see `BoardClock`; wrong_length, wrong_crc, unusable, from_others: refused packets;
command_timeouts: times that commands stopped; board_restarts: restarts of the board's counter;
network_errors: errors of the connection.
"""


def clamp_for_board(command: JointCommand, robot: Robot) -> JointCommand:
    """Clamp a command to the limits of the robot, and replace damping mode by a servo without stiffness.

    Boards do not define the damping of mode 0, so braking is sent as a servo with kp = 0 and the
    requested kd.

    Args:
        command: The joint command.
        robot: Limits of the joints.

    Returns:
        The command to encode.
    """
    braking = command.mode == MODE_DAMPING
    return JointCommand(
        q=np.minimum(np.maximum(command.q, robot.command_lower), robot.command_upper),
        dq=np.minimum(np.maximum(command.dq, -robot.velocity_limit), robot.velocity_limit),
        tau=0.0 * command.tau
        if braking
        else np.minimum(np.maximum(command.tau, -robot.torque_limit), robot.torque_limit),
        kp=0.0 * command.kp if braking else command.kp,
        kd=command.kd,
        mode=MODE_SERVO if braking else command.mode,
        tick=command.tick,
    )


def _check_plausible(robot: RobotState) -> None:
    """Raise WireError if a well-formed state has no meaning, such as one of a board that has not started."""
    if robot.tick == 0:
        raise WireError("state: tick is 0, expected a counter that runs: the board has not started")
    length = math.hypot(*robot.quaternion.tolist())
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        zeros = ", and all joints are at 0" if not robot.q.any() else ""
        raise WireError(f"state: quaternion has length {length:.3g}, expected 1{zeros}")
