"""The link to the robot's board over UDP: commands out without a gap, the newest state in. No ROS.

The link has a thread of its own (`run`). It hands on each new state, and sends: a command at once when it is given, and the
last one again and again in between, so that a lost packet costs two milliseconds. Where commands stop, where the operator
stopped the robot, and at the end it brakes: it sends damping. The board brakes by itself where packets stop.
"""

from __future__ import annotations

import math
import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import attrs
import numpy as np
from attrs.validators import ge, gt, le

from quadvel_description.robot import COMMAND_LOWER, COMMAND_UPPER, TORQUE_LIMIT, VELOCITY_LIMIT
from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand, RobotState
from quadvel_nodes.messages import QUATERNION_TOLERANCE

from . import wire
from .board_clock import BoardClock
from .calibration import Calibration
from .wire import BoardState, WireError

SEND_PERIOD = 0.002  # s, between two packets at most, as Unitree's examples have it
FAREWELL = 10  # packets of damping at the end: some may be lost
MAX_AGE = 100  # ms, of the state that a command answers
MAX_DATAGRAMS = 256  # taken in at once, so that a flood does not keep the link from sending
SILENCE = 0.1  # s without a new state, after which the board counts as silent
_WRAP = 2**32


NO_CALIBRATION = Calibration()


class LinkError(ValueError):
    """Why there can be no link, in one sentence."""


def _setting(default: Any, description: str, *validators: Any) -> Any:
    return attrs.field(default=default, validator=list(validators), metadata={"description": description})


@attrs.frozen(kw_only=True, slots=False)  # to stand beside another base
class LinkConfig:
    """Where the board is, and when to brake. Raises ValueError where a number can't be."""

    board_address: str = _setting("192.168.123.10", "IP address of the robot's board")
    board_port: int = _setting(8007, "UDP port of the board", ge(1), le(65535))
    local_address: str = _setting("", "own IP address to use; empty: the one that reaches the board")
    local_port: int = _setting(
        8082, "own UDP port, to which the board answers; 0: any that is free", ge(0), le(65535)
    )
    interface: str = _setting("", "network interface to use alone, such as eth0; empty: any")
    command_timeout: float = _setting(
        0.02, "s without a new low_cmd after which the driver brakes the joints", gt(0.0), le(0.5)
    )
    damping_kd: float = _setting(5.0, "gain with which it brakes them, N m s/rad", gt(0.0), le(20.0))

    @property
    def board(self) -> tuple[str, int]:
        """Address and port of the board."""
        return self.board_address, self.board_port


@attrs.frozen
class LinkReport:
    """How the link does: rates (1/s) and silence (s) now, counts since the start."""

    state_rate: float
    send_rate: float
    silence: float  # s since the last new state, inf before the first
    commanded: bool  # whether the board gets commands that came in, and not the link's own damping
    tick_unit: str  # in which the board counts: "ms", "us", or "" as long as it is not known
    counter_rate: float | None  # counts a second, where they fit neither
    counts: dict[str, int]
    last_refusal: str  # why the last datagram was not used
    last_error: str  # what the network said last


class UdpLink:
    """One board. `on_state` is called in the link's thread with each new state, its `time` (s) on `clock`, its `tick` in ms.

    calibration: of this robot; states and commands are set right by it. endpoint: in place of a socket to the board. Raises
    LinkError where there can be none. All methods but `run` may be called from any thread.
    """

    def __init__(
        self,
        config: LinkConfig,
        on_state: Callable[[BoardState], None],
        calibration: Calibration = NO_CALIBRATION,
        endpoint: socket.socket | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config = config
        self._on_state = on_state
        self._calibration = calibration
        self._clock = clock
        self._socket = endpoint or _connected(config)
        self._board_clock = BoardClock()
        self._lock = threading.Lock()  # around what follows
        self._damping = self._packed(JointCommand.damping(config.damping_kd))
        self._packet, self._mode = self._damping, MODE_DAMPING
        self._commanded_at = -math.inf
        self._braked = self._stopped = self._in_command = False
        self._send_next = -math.inf
        self._tick = 0
        self._heard_at = -math.inf
        self._counts: Counter[str] = Counter()
        self._last_refusal = self._last_error = ""
        self._reported_at, self._reported = clock(), Counter[str]()

    @property
    def local_port(self) -> int:
        """The own UDP port."""
        return int(self._socket.getsockname()[1])

    def run(self) -> None:
        """Send and receive until `stop`; then brake the robot and close the socket."""
        try:
            while not self._stopped:
                select.select([self._socket], [], [], self._until_sending())
                self.serve()
            self._say_farewell()
        finally:
            self._socket.close()

    def serve(self) -> None:
        """One turn of `run`: take in what has come, and send if it is time. For those that have a clock of their own."""
        self._receive()
        self._repeat()

    def stop(self) -> None:
        """End `run`."""
        self._stopped = True

    def submit(self, command: JointCommand) -> None:
        """Send a command and hold it. ValueError says why it is refused: not finite, too old, or of an unknown mode."""
        self._check_age(command.tick)
        packet = self._packed(command)
        with self._lock:
            self._packet, self._mode, self._commanded_at = packet, command.mode, self._clock()
            if not self._braked:
                self._send(packet)

    def brake(self) -> None:
        """Brake the joints from now on, whatever is commanded, until `release`."""
        with self._lock:
            self._braked = True
            self._send(self._damping)

    def release(self) -> str:
        """Follow commands again, if they damp: a robot must not jump. Why not, in one sentence, or ""."""
        with self._lock:
            if self._is_fresh() and self._mode != MODE_DAMPING:
                return "the controller still drives the joints; it has to be passive first"
            self._braked = False
            return ""

    def report(self) -> LinkReport:
        """How it did since the last report."""
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
                silence=now - self._heard_at,
                commanded=self._is_fresh() and not self._braked,
                tick_unit="" if board.unit is None else {1e-3: "ms", 1e-6: "us"}[board.unit],
                counter_rate=board.rate,
                counts={name: counts[name] for name in COUNTED},
                last_refusal=self._last_refusal,
                last_error=self._last_error,
            )

    # Receiving.

    def _receive(self) -> None:
        """Take in all that has come, and hand on the newest."""
        newest = None
        for datagram in self._datagrams():
            state = self._accept(datagram)
            if state is None:
                continue
            if newest is not None:
                self._count("superseded")
            newest = state
        if newest is not None:
            self._tick, self._heard_at = newest.robot.tick, self._clock()
            self._count("states")
            self._on_state(newest)

    def _datagrams(self) -> list[bytes]:
        """What the board sent since the last time."""
        datagrams = []
        for _ in range(MAX_DATAGRAMS):
            try:
                data, sender = self._socket.recvfrom(65536)
            except BlockingIOError:
                break
            except OSError as error:  # the board's machine has no such port, or the network is down
                self._note_error(error)
                continue
            if sender == self._socket.getpeername():
                datagrams.append(data)
            else:  # it came between binding and connecting; later ones the kernel keeps away
                self._count("from_others")
        return datagrams

    def _accept(self, datagram: bytes) -> BoardState | None:
        """The state in a datagram if it is fit for use and newer than those before."""
        try:
            state = wire.decode_state(datagram)
            _check(state.robot)
        except WireError as error:
            self._count({wire.LENGTH: "wrong_length", wire.CRC: "wrong_crc"}.get(error.about, "unusable"))
            self._last_refusal = str(error)
            return None
        instant = self._board_clock.follow(state.robot.tick, self._clock())
        if instant is None:
            return None
        state.robot = attrs.evolve(self._calibration.apply(state.robot), time=instant.time, tick=instant.tick)
        return state

    def _count(self, name: str) -> None:
        with self._lock:
            self._counts[name] += 1

    def _packed(self, command: JointCommand) -> bytes:
        return wire.encode_command(self._calibration.invert(for_the_board(command)))

    # Sending; with the lock held.

    def _until_sending(self) -> float:
        return min(max(self._send_next - self._clock(), 0.0), SEND_PERIOD)

    def _repeat(self) -> None:
        """Send what the joints are to do once more, if it is time."""
        with self._lock:
            if self._clock() < self._send_next:
                return
            fresh = self._is_fresh()
            if self._in_command and not fresh:
                self._counts["command_timeouts"] += 1
            self._in_command = fresh
            self._send(self._packet if fresh and not self._braked else self._damping)

    def _is_fresh(self) -> bool:
        return self._clock() - self._commanded_at <= self._config.command_timeout

    def _send(self, packet: bytes) -> None:
        self._send_next = self._clock() + SEND_PERIOD
        try:
            self._socket.send(packet)
            self._counts["sent"] += 1
        except OSError as error:
            self._counts["network_errors"] += 1
            self._last_error = str(error)

    def _say_farewell(self) -> None:
        for _ in range(FAREWELL):
            with self._lock:
                self._send(self._damping)
            time.sleep(SEND_PERIOD)

    def _note_error(self, error: OSError) -> None:
        with self._lock:
            self._counts["network_errors"] += 1
            self._last_error = str(error)

    def _check_age(self, tick: int) -> None:
        """Raises ValueError where a command answers a state that is to come, or one of long ago."""
        if self._heard_at == -math.inf:  # it answers somebody else's, in a dry run beside a simulator
            return
        age = (self._tick - tick + _WRAP // 2) % _WRAP - _WRAP // 2  # ms
        if age < 0:
            raise ValueError(f"it answers tick {tick}, which is to come: the newest is {self._tick}")
        if age > MAX_AGE:
            raise ValueError(f"it answers tick {tick}, {age} ms ago: expected at most {MAX_AGE} ms")


COUNTED = (
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
"""What a report counts: states handed on, packets sent, states that newer ones overtook, that came twice, that came after
newer ones; datagrams of a wrong length, with a wrong CRC, with unusable content, from somebody else; how often commands
stopped; how often the board began to count anew; errors that the network told."""


def for_the_board(command: JointCommand) -> JointCommand:
    """What the board is sent for a command: within the robot's limits, and braking in so many words.

    In mode 0 a board brakes as it likes; a servo without stiffness brakes with the gain that was asked for.
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


def _check(robot: RobotState) -> None:
    """Raises WireError where a state is well formed but says nothing, as those of a board that has not started."""
    if robot.tick == 0:
        raise WireError("state: tick is 0, expected a counter that runs: the board has not started")
    length = math.hypot(*robot.quaternion.tolist())
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        zeros = ", and all joints are at 0" if not robot.q.any() else ""
        raise WireError(f"state: quaternion has length {length:.3g}, expected 1{zeros}")


def _connected(config: LinkConfig) -> socket.socket:
    """A socket that only the board can reach. Raises LinkError."""
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
