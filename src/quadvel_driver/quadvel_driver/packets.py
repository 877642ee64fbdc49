"""Parts that the packets of all Unitree boards share: CRC, wireless remote, errors. No sockets.

`wire` (UDP boards) and `unitree_dds.wire` (CDR samples) encode their packets with it.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping
from functools import lru_cache
from itertools import accumulate
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from quadvel_description.arrays import Array
from quadvel_description.state import JointCommand, RobotState

from .board_state import Button, Remote

JOINTS = 12
SLOTS = 20  # motors in a packet; quadrupeds use the first twelve

POSITION_OFF, VELOCITY_OFF = 2.146e9, 16000.0  # q and dq that disable the stiffness or damping term
FLOAT32_MAX = float(np.finfo(np.float32).max)
LENGTH, CRC, CONTENT = "length", "CRC", "content"
_BITS_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_STICKS = ("lx", "ly", "rx", "ry")
_COMMAND_FIELDS = ("q", "dq", "tau", "kp", "kd")
_STATE_LENGTHS = {
    **dict.fromkeys(("q", "dq", "tau"), JOINTS),
    **{"quaternion": 4, "angular_velocity": 3, "linear_acceleration": 3, "foot_force": 4},
}
# Slice of each field in the concatenated numbers.
_STATE_SLICES = {
    field: slice(end - length, end)
    for (field, length), end in zip(_STATE_LENGTHS.items(), accumulate(_STATE_LENGTHS.values()), strict=True)
}
Location: TypeAlias = Callable[[str, int], str]
"""Returns the name of the i-th number of a field: a joint, foot or axis."""
REMOTE: Final = np.dtype(
    [
        *(("head", "V2"), ("buttons", "<u2"), ("lx", "<f4"), ("rx", "<f4"), ("ry", "<f4")),
        *(("reserve", "V4"), ("ly", "<f4"), ("idle", "V16")),
    ]
)
"""Layout of the wireless remote, 40 bytes."""


class WireError(ValueError):
    """A packet must not be used, or a record cannot be sent; the text names the value found and expected.

    Attributes:
        kind: LENGTH, CRC or CONTENT.
    """

    def __init__(self, text: str, kind: str = CONTENT) -> None:
        super().__init__(text)
        self.kind = kind


def crc(data: bytes) -> int:
    """Compute the CRC of the board: CRC-32/MPEG-2 over little-endian 4-byte words, highest bit first.

    Args:
        data: Whole words.

    Returns:
        The CRC.
    """
    # zlib computes the reflected CRC-32 (polynomial 0x04C11DB7). Reversing the bits of input bytes and
    # result gives the CRC without reflection; MPEG-2 has no final inversion.
    words = np.frombuffer(data, "<u4").byteswap().tobytes()
    reflected = zlib.crc32(words.translate(_BITS_REVERSED)) ^ 0xFFFFFFFF
    return int.from_bytes(reflected.to_bytes(4, "little").translate(_BITS_REVERSED), "big")


def check_crc(kind: str, found: bytes, covered: bytes) -> None:
    """Check the CRC of a packet.

    Args:
        kind: Kind of packet, for the error.
        found: The CRC in the packet, 4 bytes.
        covered: The bytes that it covers, whole words.

    Raises:
        WireError: The CRC differs.
    """
    value, expected = int.from_bytes(found, "little"), crc(covered)
    if value != expected:
        raise WireError(f"{kind}: CRC is 0x{value:08X}, expected 0x{expected:08X}", CRC)


@lru_cache(maxsize=1)  # the remote seldom changes from one state to the next
def encode_remote(remote: Remote) -> bytes:
    """Encode the wireless remote.

    Args:
        remote: Its state.

    Returns:
        40 bytes.
    """
    fields = np.zeros(1, REMOTE)
    fields["buttons"] = int(remote.buttons)
    for stick in _STICKS:
        fields[stick] = getattr(remote, stick)
    return fields.tobytes()


@lru_cache(maxsize=1)
def decode_remote(data: bytes) -> Remote:
    """Decode the wireless remote.

    Args:
        data: 40 bytes.

    Returns:
        State of the remote. If a stick is not finite, the remote counts as off: the packet itself
        is not refused.
    """
    fields = np.frombuffer(data, REMOTE)[0]
    sticks = {stick: float(fields[stick]) for stick in _STICKS}
    if not all(map(math.isfinite, sticks.values())):
        return Remote()
    return Remote(Button(int(fields["buttons"])), **sticks)


def roll_pitch_yaw(quaternion: Array) -> tuple[float, float, float]:
    """Return the angles of rotations about z, y, x in this order.

    Args:
        quaternion: (w, x, y, z), of any length.

    Returns:
        Roll, pitch and yaw, rad; zeros for a zero quaternion.
    """
    length = math.hypot(*quaternion.tolist())
    w, x, y, z = (quaternion / length).tolist() if length > 0.0 else (1.0, 0.0, 0.0, 0.0)
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(max(-1.0, min(2.0 * (w * y - z * x), 1.0))),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def command_numbers(command: JointCommand, location: Location) -> Array:
    """Return the numbers of a command.

    Args:
        command: The command.
        location: Names a number in the error.

    Returns:
        q (rad), dq (rad/s), tau (N m), kp (N m/rad) and kd (N m s/rad), (5, 12).

    Raises:
        WireError: A number is not finite.
    """
    numbers = np.array([getattr(command, field) for field in _COMMAND_FIELDS], float)
    require_finite_command(numbers, location)
    return numbers


def require_finite_command(numbers: NDArray[np.floating[Any]], location: Location) -> None:
    """Refuse numbers of a command that are not finite.

    Args:
        numbers: q, dq and further fields in the order of a command, (1 to 5, 12).
        location: Names a number in the error.

    Raises:
        WireError: A number is not finite.
    """
    if np.count_nonzero(np.isfinite(numbers)) < numbers.size:
        raise not_finite("command", dict(zip(_COMMAND_FIELDS, numbers, strict=False)), location)


def state_numbers(robot: RobotState, location: Location) -> dict[str, Array]:
    """Return the numbers of a state, clamped to the range of float32.

    Args:
        robot: The state.
        location: Names a number in the error.

    Returns:
        q, dq, tau, quaternion, angular_velocity, linear_acceleration and foot_force by name.

    Raises:
        WireError: A number is not finite.
    """
    numbers = np.concatenate([getattr(robot, field) for field in _STATE_SLICES])
    if np.count_nonzero(np.isfinite(numbers)) < numbers.size:
        raise not_finite("state", {field: getattr(robot, field) for field in _STATE_SLICES}, location)
    numbers = np.minimum(np.maximum(numbers, -FLOAT32_MAX), FLOAT32_MAX)
    return {field: numbers[part] for field, part in _STATE_SLICES.items()}


def not_finite(kind: str, numbers: Mapping[str, NDArray[np.floating[Any]]], location: Location) -> WireError:
    """Create the error for the first field with a number that is not finite.

    Args:
        kind: Kind of packet.
        numbers: Fields by name, of which one holds such a number.
        location: Name of the i-th number of a field.

    Returns:
        The error.
    """
    for field, values in numbers.items():
        for i, value in enumerate(values):
            if not np.isfinite(value):
                return WireError(
                    f"{kind}: {field} of {location(field, i)} is {value}, expected a finite number"
                )
    raise AssertionError("all are finite")
