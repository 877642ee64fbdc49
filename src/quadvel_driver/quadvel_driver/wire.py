"""Encoding and decoding of the packets of the AlienGo's board: commands (610 bytes) and states (771 bytes).

The formats are those of Unitree's SDK for the AlienGo from 3.2 to 3.8.4 (firmware 0.1.35 and
newer). The functions convert bytes to plain records and back; `link` handles sockets and time.

Only whole packets are accepted. The CRC covers whole 4-byte words from the start; the remaining
bytes, at the end of the field `reserve`, are not covered. They must be zero, as the SDK sends them,
so that no flipped bit passes.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from quadvel_description.arrays import Array
from quadvel_description.quadruped import JOINT_NAMES, LEGS
from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand, RobotState

from .board_state import BoardState
from .packets import (
    JOINTS,
    LENGTH,
    POSITION_OFF,
    SLOTS,
    VELOCITY_OFF,
    WireError,
    check_crc,
    command_numbers,
    crc,
    decode_remote,
    encode_remote,
    not_finite,
    require_finite_command,
    roll_pitch_yaw,
    state_numbers,
)

LOW_LEVEL = 0xFF  # levelFlag of a joint command

_HEADER = [
    ("level_flag", "u1"),
    ("version", "<u2"),
    ("robot_id", "<u2"),
    ("serial", "<u4"),
    ("bandwidth", "u1"),
]
_TAIL = [("remote", "V40"), ("reserve", "<u4"), ("crc", "<u4")]
_MOTOR_COMMAND = np.dtype(
    [
        ("mode", "u1"),
        ("q", "<f4"),
        ("dq", "<f4"),
        ("tau", "<i2"),
        ("kp", "<i2"),
        ("kd", "<i2"),
        ("reserve", "V12"),
    ]
)
_MOTOR_STATE = np.dtype(
    [
        *(("mode", "u1"), ("q", "<f4"), ("dq", "<f4"), ("ddq", "<i2"), ("tau", "<i2")),
        *(("q_raw", "<f4"), ("dq_raw", "<f4"), ("ddq_raw", "<i2")),
        *(("temperature", "i1"), ("error", "<u4"), ("reserve", "<u4")),
    ]
)
_IMU = [
    *(("quaternion", "<f4", 4), ("angular_velocity", "<f4", 3), ("linear_acceleration", "<f4", 3)),
    *(("rpy", "<f4", 3), ("imu_temperature", "i1")),
]
_IMU_OFFSET = np.dtype(_HEADER).itemsize  # bytes
_IMU_NUMBERS = 4 + 3 + 3  # quaternion, angular velocity, linear acceleration
_COMMAND: Final = np.dtype([*_HEADER, ("motors", _MOTOR_COMMAND, SLOTS), ("led", "V12"), *_TAIL])
_STATE: Final = np.dtype(
    [
        *(*_HEADER, *_IMU, ("motors", _MOTOR_STATE, SLOTS)),
        *(("foot_force", "<i2", 4), ("foot_force_estimate", "<i2", 4), ("tick", "<u4"), *_TAIL),
    ]
)
COMMAND_BYTES, STATE_BYTES = _COMMAND.itemsize, _STATE.itemsize
"""Lengths of the packets: 610 and 771."""

OTHER_FORMATS = {
    540: "the command of firmware 3.1 (aliengo_sdk 1.2)",
    684: "the state of firmware 3.1 (aliengo_sdk 1.2)",
    614: "the command of a Go1",
    807: "the state of a Go1",
    730: "the command as the SDK's programs hold it",
    891: "the state as the SDK's programs hold it",
}
"""Packets of other robots and versions, by length."""

# Counts per N m, N m/rad, N m s/rad. Fractions of a count are truncated towards zero, as in the SDK.
_TAU_COUNTS_PER_NM, _KP, _KD = 256.0, 32.0, 16.0
_SCALES = np.array([[_TAU_COUNTS_PER_NM], [_KP], [_KD]], np.float32)
_COUNTS = 2**15  # range of an int16 field: -2^15 to 2^15 - 1
# Bounds of q, dq, tau, kp, kd. No joint reaches 100 rad or 1000 rad/s, and POSITION_OFF is far away.
_COMMAND_MIN = np.array([[-100.0], [-1000.0], [-_COUNTS / _TAU_COUNTS_PER_NM], [0.0], [0.0]])
_COMMAND_MAX = np.array(
    [[100.0], [1000.0], *([(_COUNTS - 1) / scale] for scale in (_TAU_COUNTS_PER_NM, _KP, _KD))]
)

_AXES = ("w", "x", "y", "z")


def encode_command(command: JointCommand) -> bytes:
    """Encode a joint command; its `tick` is not part of the packet.

    Values are clamped to the range of their fields, because fixed-point fields would wrap (200 N m
    would become -56); negative gains become zero.

    Args:
        command: Angles rad, speeds rad/s, torques N m, gains N m/rad and N m s/rad, each (12,).

    Returns:
        The packet, COMMAND_BYTES long.

    Raises:
        WireError: A number is not finite, or the mode is unknown.
    """
    if command.mode not in (MODE_DAMPING, MODE_SERVO):
        raise WireError(f"command: mode is {command.mode}, expected {MODE_DAMPING} or {MODE_SERVO}")
    # Rows q, dq, tau, kp, kd; numbers that are not finite are refused.
    numbers = command_numbers(command, _location)
    numbers = np.minimum(np.maximum(numbers, _COMMAND_MIN), _COMMAND_MAX).astype(np.float32)
    packet = np.zeros(1, _COMMAND)
    packet["level_flag"] = LOW_LEVEL
    motors = packet["motors"][0, :JOINTS]
    motors["mode"] = command.mode
    motors["q"], motors["dq"] = numbers[:2]
    motors["tau"], motors["kp"], motors["kd"] = (numbers[2:] * _SCALES).astype(np.int16)
    return _pack(packet)


def decode_command(data: bytes) -> JointCommand:
    """Decode a command packet.

    The mode of the command is damping if all motors are in damping mode. If only some are, those
    have zero stiffness, target speed and torque; `commanded_modes` returns the mode of each.

    Args:
        data: The packet.

    Returns:
        The joint command.

    Raises:
        WireError: The packet is not a valid command.
    """
    packet = _unpack(data, "command", _COMMAND)
    if packet["level_flag"] != LOW_LEVEL:
        found = f"0x{packet['level_flag']:02X}"
        raise WireError(f"command: levelFlag is {found}, expected 0x{LOW_LEVEL:02X}: the low level")
    motors = packet["motors"][:JOINTS]
    numbers = np.array((motors["q"], motors["dq"]))
    require_finite_command(numbers, _location)  # before the cast, which warns of NaN
    q, dq = numbers.astype(float)
    no_position, no_velocity = q >= POSITION_OFF, dq >= VELOCITY_OFF
    mode = _mode(motors["mode"])
    brakes = (motors["mode"] == MODE_DAMPING) & (mode == MODE_SERVO)
    return JointCommand(
        q=np.where(no_position, 0.0, q),
        dq=np.where(no_velocity | brakes, 0.0, dq),
        tau=np.where(brakes, 0.0, motors["tau"] / _TAU_COUNTS_PER_NM),
        kp=np.where(no_position | brakes, 0.0, motors["kp"] / _KP),
        kd=np.where(no_velocity, 0.0, motors["kd"] / _KD),
        mode=mode,
    )


def commanded_modes(data: bytes) -> NDArray[np.uint8]:
    """Return the mode of each motor in a valid command packet.

    Args:
        data: A packet that `decode_command` accepts.

    Returns:
        Modes, (12,).
    """
    return np.array(np.frombuffer(data, _COMMAND)[0]["motors"]["mode"][:JOINTS])


def encode_state(state: BoardState) -> bytes:
    """Encode a board state, with values clamped to the range of their fields.

    Redundant fields are derived: roll, pitch and yaw, raw angles and speeds, estimated foot forces.
    Joint accelerations are 0.

    Args:
        state: The state.

    Returns:
        The packet, STATE_BYTES long.

    Raises:
        WireError: A number is not finite.
    """
    robot = state.robot
    clipped = state_numbers(robot, _location)
    packet = np.zeros(1, _STATE)
    for field in ("quaternion", "angular_velocity", "linear_acceleration"):
        packet[field] = clipped[field]
    packet["level_flag"] = LOW_LEVEL
    packet["rpy"] = roll_pitch_yaw(clipped["quaternion"])
    packet["foot_force"] = packet["foot_force_estimate"] = _counts(clipped["foot_force"])
    packet["imu_temperature"] = state.imu_temperature
    packet["tick"] = robot.tick
    packet["remote"] = np.void(encode_remote(state.remote))
    motors = packet["motors"][0, :JOINTS]
    motors["q_raw"], motors["dq_raw"] = clipped["q"], clipped["dq"]
    motors["q"], motors["dq"], motors["tau"] = (
        clipped["q"],
        clipped["dq"],
        _counts(_TAU_COUNTS_PER_NM * clipped["tau"]),
    )
    motors["mode"], motors["error"], motors["temperature"] = (
        state.motor_mode,
        state.motor_error,
        state.temperature,
    )
    return _pack(packet)


def decode_state(data: bytes) -> BoardState:
    """Decode a state packet.

    Args:
        data: The packet.

    Returns:
        The state.

    Raises:
        WireError: The packet is not a valid state.
    """
    packet = _unpack(data, "state", _STATE)
    motors = packet["motors"][:JOINTS]
    imu = np.frombuffer(data, "<f4", _IMU_NUMBERS, offset=_IMU_OFFSET)
    numbers = np.concatenate((motors["q"], motors["dq"], imu))
    if np.count_nonzero(np.isfinite(numbers)) < numbers.size:  # before the cast, which warns of NaN
        fields = ("quaternion", "angular_velocity", "linear_acceleration")
        found = {"q": motors["q"], "dq": motors["dq"], **{field: packet[field] for field in fields}}
        raise not_finite("state", found, _location)
    numbers = numbers.astype(float)
    imu = numbers[2 * JOINTS :]
    robot = RobotState(
        time=0.0,
        tick=int(packet["tick"]),
        q=numbers[:JOINTS],
        dq=numbers[JOINTS : 2 * JOINTS],
        tau=motors["tau"] / _TAU_COUNTS_PER_NM,
        quaternion=imu[:4],
        angular_velocity=imu[4:7],
        linear_acceleration=imu[7:],
        foot_force=packet["foot_force"].astype(float),
    )
    return BoardState(
        robot=robot,
        motor_mode=motors["mode"].copy(),
        motor_error=motors["error"].copy(),
        temperature=motors["temperature"].copy(),
        imu_temperature=int(packet["imu_temperature"]),
        remote=decode_remote(packet["remote"].tobytes()),
    )


def _unpack(data: bytes, kind: str, layout: np.dtype[Any]) -> np.void:
    """Return the fields of a packet with valid length and CRC; raise WireError otherwise."""
    if len(data) != layout.itemsize:
        other = OTHER_FORMATS.get(len(data))
        found = f"{len(data)} bytes" + (f", {other}" if other else "")
        raise WireError(f"{kind}: {found}, expected {layout.itemsize}", LENGTH)
    covered, end = _crc_length(layout), layout.itemsize - 4
    if any(data[covered:end]):
        raise WireError(
            f"{kind}: reserve ends with {data[covered:end].hex()}, expected zeros: the CRC does not cover it"
        )
    check_crc(kind, data[end:], data[:covered])
    packet: np.void = np.frombuffer(data, layout)[0]
    return packet


def _pack(packet: NDArray[np.void]) -> bytes:
    """Return the bytes of one packet, with its CRC."""
    packet["crc"] = crc(packet.tobytes()[: _crc_length(packet.dtype)])
    return packet.tobytes()


def _crc_length(layout: np.dtype[Any]) -> int:
    """Return the number of bytes that the CRC covers: whole words without the CRC itself."""
    return (layout.itemsize // 4 - 1) * 4


def _mode(modes: NDArray[np.uint8]) -> int:
    """Return servo mode if any motor is in it, else damping; WireError for an unknown mode."""
    unknown = (modes != MODE_DAMPING) & (modes != MODE_SERVO)
    if unknown.any():
        i = int(np.argmax(unknown))
        raise WireError(
            f"command: mode of {JOINT_NAMES[i]} is {modes[i]}, expected {MODE_DAMPING} or {MODE_SERVO}"
        )
    return MODE_SERVO if (modes == MODE_SERVO).any() else MODE_DAMPING


def _counts(values: Array) -> NDArray[np.int16]:
    return np.clip(np.trunc(values), -_COUNTS, _COUNTS - 1).astype(np.int16)


def _location(field: str, i: int) -> str:
    """Return the name of the joint, foot or axis of the i-th number of a field."""
    if field == "foot_force":
        return f"the foot {LEGS[i]}"
    if field == "quaternion":
        return f"axis {_AXES[i]}"
    return f"axis {_AXES[i + 1]}" if field in ("angular_velocity", "linear_acceleration") else JOINT_NAMES[i]
