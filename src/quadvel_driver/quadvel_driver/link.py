"""UDP link to the robot's board: sends commands without a gap and receives the newest state. No ROS.

The link runs in its own thread (`run`). It sends each command immediately and repeats the last one
every 2 ms, so a lost packet costs 2 ms. It sends damping if commands stop, if the operator stops
the robot, and at the end. The board itself brakes if packets stop.
"""

from __future__ import annotations

import math
import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable

import attrs
import numpy as np

from quadvel_description.fields import field, positive
from quadvel_description.robot import COMMAND_LOWER, COMMAND_UPPER, TORQUE_LIMIT, VELOCITY_LIMIT
from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand, RobotState
from quadvel_nodes.messages import QUATERNION_TOLERANCE

from . import wire
from .board_clock import BoardClock
from .calibration import Calibration
from .wire import BoardState, WireError

SEND_PERIOD_S = 0.002  # longest time between two packets, as in Unitree's examples
SHUTDOWN_PACKETS = 10  # number of damping packets at the end; some may be lost
MAX_COMMAND_AGE_MS = 100  # largest age of the state that a command answers
MAX_DATAGRAMS = 256  # received per turn, so that a flood cannot block sending
SILENCE_LIMIT_S = 0.1  # time without a new state after which the board counts as silent
_TICK_MODULUS = 2**32


NO_CALIBRATION = Calibration()


class LinkError(ValueError):
    """A link cannot be opened; the text is the reason, in one sentence."""


@attrs.frozen(kw_only=True, slots=False)  # for multiple inheritance
class LinkConfig:
    """Network addresses and braking of the link.

    Attributes:
        board_address: IP address of the board.
        board_port: UDP port of the board.
        local_address: Local IP address; empty for any.
        local_port: Local UDP port; 0 for any free one.
        interface: Network interface to use exclusively; empty for any.
        command_timeout: Time without a command after which the link brakes, s.
        damping_kd: Damping gain of braking, N m s/rad.

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
    interface: str = field("", "network interface to use alone, such as eth0; empty: any")
    command_timeout: float = positive(
        0.02, "s without a new low_cmd after which the driver brakes the joints", at_most=0.5
    )
    damping_kd: float = positive(5.0, "gain with which it brakes them, N m s/rad", at_most=20.0)

    @property
    def board(self) -> tuple[str, int]:
        """Address and port of the board."""
        return self.board_address, self.board_port


@attrs.frozen
class LinkReport:
    """Status of the link.

    Attributes:
        state_rate: States per second since the last report.
        send_rate: Sent packets per second since the last report.
        silence: Time since the last new state, s; inf before the first one.
        commanded: Whether the board receives commands, not the link's own damping.
        tick_unit: Unit of the board's counter, "ms" or "us"; "" until it is known.
        counter_rate: Counts per second if they match neither unit, else None.
        counts: Events since the start, see COUNTER_NAMES.
        last_refusal: Why the last refused datagram was not used.
        last_error: The last network error.
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


class UdpLink:
    """UDP link to one board. All methods except `run` and `serve` may be called from any thread."""

    def __init__(
        self,
        config: LinkConfig,
        on_state: Callable[[BoardState], None],
        calibration: Calibration = NO_CALIBRATION,
        endpoint: socket.socket | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Open a link.

        Args:
            config: Addresses and braking.
            on_state: Called in the link's thread with each new state; `time` (s) is on `clock`,
                `tick` in ms.
            calibration: Calibration of this robot, which corrects states and commands.
            endpoint: A socket that replaces the connection to the board.
            clock: A monotonic clock, s.

        Raises:
            LinkError: The socket cannot be opened.
        """
        self._config = config
        self._on_state = on_state
        self._calibration = calibration
        self._clock = clock
        self._socket = endpoint or _connect(config)
        self._board_clock = BoardClock()
        self._lock = threading.Lock()  # guards the attributes below
        self._damping = self._encode(JointCommand.damping(config.damping_kd))
        self._packet, self._mode = self._damping, MODE_DAMPING
        self._commanded_at = -math.inf
        self._is_braked = self._is_stopped = self._was_fresh = False
        self._send_next = -math.inf
        self._tick = 0
        self._last_state_at = -math.inf
        self._counts: Counter[str] = Counter()
        self._last_refusal = self._last_error = ""
        self._reported_at, self._reported = clock(), Counter[str]()

    @property
    def local_port(self) -> int:
        """Local UDP port."""
        return int(self._socket.getsockname()[1])

    def run(self) -> None:
        """Send and receive until `stop`, then brake the robot and close the socket."""
        try:
            while not self._is_stopped:
                select.select([self._socket], [], [], self._time_until_sending())
                self.serve()
            self._send_shutdown_packets()
        finally:
            self._socket.close()

    def serve(self) -> None:
        """Receive pending datagrams and send if due; for callers with a clock of their own instead of `run`."""
        self._receive()
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
            if not self._is_braked:
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
            counts.update(repeated=board.repeated, late=board.late, board_restarts=board.restarts)
            elapsed = max(now - self._reported_at, 1e-9)
            rates = {name: (counts[name] - self._reported[name]) / elapsed for name in ("states", "sent")}
            self._reported_at, self._reported = now, counts
            return LinkReport(
                state_rate=rates["states"],
                send_rate=rates["sent"],
                silence=now - self._last_state_at,
                commanded=self._is_fresh() and not self._is_braked,
                tick_unit="" if board.unit is None else {1e-3: "ms", 1e-6: "us"}[board.unit],
                counter_rate=board.rate,
                counts={name: counts[name] for name in COUNTER_NAMES},
                last_refusal=self._last_refusal,
                last_error=self._last_error,
            )

    # Receiving.

    def _receive(self) -> None:
        """Receive all pending datagrams and call `on_state` with the newest state."""
        newest = None
        for datagram in self._datagrams():
            state = self._accept(datagram)
            if state is None:
                continue
            if newest is not None:
                self._count("superseded")
            newest = state
        if newest is not None:
            self._tick, self._last_state_at = newest.robot.tick, self._clock()
            self._count("states")
            self._on_state(newest)

    def _datagrams(self) -> list[bytes]:
        """Return the pending datagrams of the board."""
        datagrams = []
        for _ in range(MAX_DATAGRAMS):
            try:
                data, sender = self._socket.recvfrom(65536)
            except BlockingIOError:
                break
            except OSError as error:  # no such port on the board, or the network is down
                self._note_error(error)
                continue
            if sender == self._socket.getpeername():
                datagrams.append(data)
            else:  # arrived between bind and connect; afterwards the kernel filters these
                self._count("from_others")
        return datagrams

    def _accept(self, datagram: bytes) -> BoardState | None:
        """Return the state of a datagram, or None if it is unusable or not newer."""
        try:
            state = wire.decode_state(datagram)
            _check_plausible(state.robot)
        except WireError as error:
            self._count({wire.LENGTH: "wrong_length", wire.CRC: "wrong_crc"}.get(error.kind, "unusable"))
            self._last_refusal = str(error)
            return None
        instant = self._board_clock.update(state.robot.tick, self._clock())
        if instant is None:
            return None
        state.robot = attrs.evolve(self._calibration.apply(state.robot), time=instant.time, tick=instant.tick)
        return state

    def _count(self, name: str) -> None:
        with self._lock:
            self._counts[name] += 1

    def _encode(self, command: JointCommand) -> bytes:
        return wire.encode_command(self._calibration.invert(clamp_for_board(command)))

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
            self._send(self._packet if fresh and not self._is_braked else self._damping)

    def _is_fresh(self) -> bool:
        return self._clock() - self._commanded_at <= self._config.command_timeout

    def _send(self, packet: bytes) -> None:
        self._send_next = self._clock() + SEND_PERIOD_S
        try:
            self._socket.send(packet)
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
repeated, late: see `BoardClock`; wrong_length, wrong_crc, unusable, from_others: refused datagrams;
command_timeouts: times that commands stopped; board_restarts: restarts of the board's counter;
network_errors: errors of the socket.
"""


def clamp_for_board(command: JointCommand) -> JointCommand:
    """Clamp a command to the limits of the robot, and replace damping mode by a servo without stiffness.

    The board does not define the damping of mode 0, so braking is sent as mode 10 with kp = 0 and
    the requested kd.

    Args:
        command: The joint command.

    Returns:
        The command to encode.
    """
    braking = command.mode == MODE_DAMPING
    return JointCommand(
        q=np.minimum(np.maximum(command.q, COMMAND_LOWER), COMMAND_UPPER),
        dq=np.minimum(np.maximum(command.dq, -VELOCITY_LIMIT), VELOCITY_LIMIT),
        tau=0.0 * command.tau
        if braking
        else np.minimum(np.maximum(command.tau, -TORQUE_LIMIT), TORQUE_LIMIT),
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


def _connect(config: LinkConfig) -> socket.socket:
    """Return a socket connected to the board; raise LinkError on failure."""
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    local = config.local_address, config.local_port
    try:
        endpoint.setblocking(False)
        if config.interface:
            endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, config.interface.encode())
        endpoint.bind(local)
        endpoint.connect(config.board)
    except (OSError, OverflowError) as error:
        endpoint.close()
        own = f"{config.local_address or 'any address'}:{config.local_port}"
        on = f" on {config.interface}" if config.interface else ""
        raise LinkError(
            f"no link from {own}{on} to {config.board_address}:{config.board_port}: {error}"
        ) from error
    return endpoint
