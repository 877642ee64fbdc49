"""The messages of each control tick as bytes, without an object for each field.

LowState, LowCmd and the velocity estimate have fixed layouts in CDR, the encoding of DDS. A
subscription with `raw=True` delivers these bytes, and a publisher accepts them. All other messages
pass as objects (`messages`).

A number is aligned to its own size, counted from the end of the 4 bytes of encapsulation::

    LowState            stamp (s, ns), tick, 50 float32
    LowCmd              stamp (s, ns), tick, mode, 3 bytes, 60 float32
    velocity estimate   stamp (s, ns), length and characters of frame_id, bytes up to a multiple
                        of 8, 6 float64 (linear, angular), 36 float64 (covariance)
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.state import JointCommand, RobotState

from .messages import (
    LOW_CMD_SIZES,
    LOW_STATE_SIZES,
    MessageError,
    require_finite,
    robot_state,
)

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
"""Encapsulation of plain CDR, little endian: all messages of a little-endian machine."""
_STATE_HEAD, _COMMAND_HEAD = struct.Struct("<4siII"), struct.Struct("<4siIIB3x")
_ESTIMATE_HEAD = struct.Struct("<4siII")


def _places(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Return the place of each field in the numbers of a message."""
    ends = pairwise(accumulate(sizes.values(), initial=0))
    return {name: slice(*place) for name, place in zip(sizes, ends, strict=True)}


_STATE, _COMMAND, _ESTIMATE = map(_places, (LOW_STATE_SIZES, LOW_CMD_SIZES, {"linear": 3}))
Stamp = tuple[int, int]
"""Time as s and ns."""


def decode_low_state(data: bytes) -> tuple[Stamp, RobotState]:
    """Convert a LowState to a RobotState and normalise its quaternion.

    Args:
        data: The LowState in CDR.

    Returns:
        The stamp, and the state; its `time` is the stamp, s.

    Raises:
        MessageError: The bytes are no LowState.
        NotFiniteError: A number is NaN or infinite.
        NotUnitError: The norm of the quaternion is not 1 within QUATERNION_TOLERANCE.
    """
    seconds, nanoseconds, tick = _unpack(_STATE_HEAD, data)
    fields = _numbers(data, _STATE_HEAD.size, np.float32, _STATE)
    return (seconds, nanoseconds), robot_state(float(seconds + 1e-9 * nanoseconds), tick, fields)


def encode_low_state(stamp: Stamp, state: RobotState) -> bytes:
    """Convert a RobotState to a LowState.

    Args:
        stamp: Time of the state, (s, ns).
        state: The state.

    Returns:
        The LowState in CDR.
    """
    head = _STATE_HEAD.pack(LITTLE_ENDIAN, *stamp, state.tick)
    fields = (state.q, state.dq, state.tau, state.quaternion)
    more = (state.angular_velocity, state.linear_acceleration, state.foot_force)
    return head + np.concatenate((*fields, *more), dtype=np.float32, casting="same_kind").tobytes()


def decode_low_cmd(data: bytes) -> JointCommand:
    """Convert a LowCmd to a JointCommand.

    Args:
        data: The LowCmd in CDR.

    Returns:
        The joint command.

    Raises:
        MessageError: The bytes are no LowCmd.
        NotFiniteError: A number is NaN or infinite.
    """
    _, _, tick, mode = _unpack(_COMMAND_HEAD, data)
    q, dq, tau, kp, kd = _numbers(data, _COMMAND_HEAD.size, np.float32, _COMMAND)
    return JointCommand(q, dq, tau, kp, kd, mode, tick)


def encode_low_cmd(stamp: Stamp, command: JointCommand) -> bytes:
    """Convert a JointCommand to a LowCmd.

    Args:
        stamp: Present time, (s, ns).
        command: The joint command.

    Returns:
        The LowCmd in CDR.
    """
    head = _COMMAND_HEAD.pack(LITTLE_ENDIAN, *stamp, command.tick, command.mode)
    fields = (command.q, command.dq, command.tau, command.kp, command.kd)
    return head + np.concatenate(fields, dtype=np.float32, casting="same_kind").tobytes()


def encode_estimate(
    stamp: Stamp, frame: str, linear: ArrayLike, angular: ArrayLike, covariance: Array
) -> bytes:
    """Write a velocity estimate, a geometry_msgs/TwistWithCovarianceStamped.

    Args:
        stamp: Time of the estimate, (s, ns).
        frame: Frame of the velocities.
        linear: Linear velocity, (3,), m/s.
        angular: Angular velocity, (3,), rad/s.
        covariance: Covariance, (36,): velocities along x, y, z (m/s) and rates about them (rad/s).

    Returns:
        The message in CDR.
    """
    name = frame.encode() + b"\0"
    head = _ESTIMATE_HEAD.pack(LITTLE_ENDIAN, *stamp, len(name)) + name
    return (
        head.ljust(_estimate_offset(len(name)), b"\0")
        + np.concatenate((linear, angular, covariance)).tobytes()
    )


def decode_estimate(data: bytes) -> tuple[float, Array]:
    """Read a velocity estimate, a geometry_msgs/TwistWithCovarianceStamped.

    Args:
        data: The message in CDR.

    Returns:
        Time of the estimate, s, and linear velocity, (3,), m/s.

    Raises:
        MessageError: The bytes are no such message.
        NotFiniteError: A number of the velocity is NaN or infinite.
    """
    seconds, nanoseconds, length = _unpack(_ESTIMATE_HEAD, data)
    (velocity,) = _numbers(data, _estimate_offset(length), np.float64, _ESTIMATE)
    return float(seconds + 1e-9 * nanoseconds), velocity


def _estimate_offset(length: int) -> int:
    """Return the place of the first number after a frame_id of `length` bytes."""
    return 4 + -(-(_ESTIMATE_HEAD.size - 4 + length) // 8) * 8


def _unpack(head: struct.Struct, data: bytes) -> tuple[int, ...]:
    """Return the numbers of the head after the encapsulation."""
    if len(data) < head.size or not data.startswith(LITTLE_ENDIAN[:2]):
        raise MessageError(f"message begins with {data[:4].hex()}, expected {LITTLE_ENDIAN.hex()} and a head")
    return head.unpack_from(data)[1:]


def _numbers(data: bytes, offset: int, kind: type[np.floating], places: dict[str, slice]) -> list[Array]:
    """Return the fields from a byte on, finite, as float64."""
    count = next(reversed(places.values())).stop
    if len(data) < offset + count * np.dtype(kind).itemsize:
        raise MessageError(f"message has {len(data)} bytes, expected {count} numbers from byte {offset} on")
    block = np.frombuffer(data, kind, count, offset).astype(np.float64)
    if np.count_nonzero(np.isfinite(block)) < count:  # faster than np.all for short arrays
        for name, place in places.items():
            require_finite(name, block[place])
    return [block[place] for place in places.values()]
