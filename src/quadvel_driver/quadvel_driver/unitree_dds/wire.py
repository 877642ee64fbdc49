"""Encoding and decoding of `rt/lowcmd` and `rt/lowstate` (types of `unitree_go`): CDR bytes and plain records.

A sample is XCDR1, little endian: an encapsulation header of 4 bytes and a body of 808 (LowCmd) or
1176 (LowState) bytes. Its CRC is not that of these bytes, but of the C structure in the memory of
the robot, which holds the same fields at other places: its first motor starts at a multiple of 4.
Padding of the body is covered, too, and has to be zero, so no flipped bit passes.

A message has room for 20 motors; quadrupeds use the first twelve, in the order FR, FL, RR, RL, each
hip, thigh, calf. `link` handles time, `bus` handles DDS. `board_state` and
`quadvel_description.state` give the units and frames of the records.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from quadvel_description.state import MODE_SERVO, JointCommand, RobotState
from quadvel_driver.board_state import Battery, BoardState
from quadvel_driver.packets import (
    FLOAT32_MAX,
    JOINTS,
    LENGTH,
    POSITION_OFF,
    REMOTE,
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

MOTOR_OFF, MOTOR_SERVO = 0, 1  # modes of a motor; a motor that is off turns freely
HEADER: Final = bytes([0, 1, 0, 0])  # plain CDR, little endian, no options
HEAD: Final = bytes([0xFE, 0xEF])
LOW_LEVEL = 0xFF  # level_flag of a joint command

# Places in a sample: those in the body, plus 4 for the encapsulation header.
_HEAD_AT, _LEVEL_AT = 4, 6
_COMMAND_MOTORS_AT, _COMMAND_STRIDE = 28, 36  # q of the first motor
_COMMAND_MODES_AT: Final = np.array([26, *(24 + _COMMAND_STRIDE * i for i in range(1, SLOTS))])
_STATE_MOTORS_AT, _STATE_STRIDE = 80, 48
_STATE_MODES_AT: Final = np.array([81, *(_STATE_MOTORS_AT + _STATE_STRIDE * i for i in range(1, SLOTS))])
COMMAND_BYTES, STATE_BYTES = 812, 1180
"""Lengths of the samples."""

_MOTOR_STATE = np.dtype(
    {
        "names": ["q", "dq", "tau", "q_raw", "dq_raw", "temperature", "lost"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<f4", "i1", "<u4"],
        "offsets": [4, 8, 16, 20, 24, 32, 36],
        "itemsize": _STATE_STRIDE,
    }
)
_STATE: Final[np.dtype[Any]] = np.dtype(
    {
        "names": [
            *("quaternion", "angular_velocity", "linear_acceleration", "rpy", "imu_temperature"),
            *("motors", "charge", "foot_force", "foot_force_estimate", "tick", "remote"),
            *("voltage", "current"),
        ],
        "formats": [
            *(("<f4", 4), ("<f4", 3), ("<f4", 3), ("<f4", 3), "i1"),
            *((_MOTOR_STATE, SLOTS), "u1", ("<i2", 4), ("<i2", 4), "<u4", f"V{REMOTE.itemsize}"),
            *("<f4", "<f4"),
        ],
        "offsets": [
            *(28, 44, 56, 68, 80),
            *(_STATE_MOTORS_AT, 1043, 1084, 1092, 1100, 1104),
            *(1156, 1160),
        ],
        "itemsize": STATE_BYTES,
    }
)
_IMU_AT, _IMU_NUMBERS = 28, 10  # quaternion, angular velocity, linear acceleration

_COMMAND_MIN = np.array([[-FLOAT32_MAX], [-FLOAT32_MAX], [-FLOAT32_MAX], [0.0], [0.0]])


def _command_template() -> bytes:
    """Return a command of zeros: twelve motors in servo mode, the others off."""
    sample = bytearray(COMMAND_BYTES)
    sample[: len(HEADER)] = HEADER
    sample[_HEAD_AT : _LEVEL_AT + 1] = HEAD + bytes([LOW_LEVEL])
    for place in _COMMAND_MODES_AT[:JOINTS].tolist():
        sample[place] = MOTOR_SERVO
    return bytes(sample)


_COMMAND_TEMPLATE: Final = _command_template()


def command_struct(sample: bytes | bytearray) -> bytes:
    """Return the bytes of a LowCmd that its CRC covers: the C structure without the CRC.

    Args:
        sample: The CDR sample.

    Returns:
        202 words.
    """
    return b"".join((sample[4:26], bytes(2), sample[26:28], bytes(2), sample[28:-4]))


def state_struct(sample: bytes | bytearray) -> bytes:
    """Return the bytes of a LowState that its CRC covers: the C structure without the CRC.

    Args:
        sample: The CDR sample.

    Returns:
        294 words.
    """
    return b"".join((sample[4:81], bytes(3), sample[81:84], bytes(1), sample[84:-4]))


def encode_command(command: JointCommand) -> bytes:
    """Encode a joint command; its `tick` is not part of the sample.

    Negative gains become zero.

    Args:
        command: Angles rad, speeds rad/s, torques N m, gains N m/rad and N m s/rad, each (12,).

    Returns:
        The CDR sample, COMMAND_BYTES long.

    Raises:
        WireError: A number is not finite, or the mode is not MODE_SERVO: these drives have no
            damping mode; send a servo without stiffness.
    """
    if command.mode != MODE_SERVO:
        raise WireError(f"command: mode is {command.mode}, expected {MODE_SERVO}")
    numbers = command_numbers(command, _location)
    sample = bytearray(_COMMAND_TEMPLATE)
    _command_numbers(sample)[:] = np.minimum(np.maximum(numbers, _COMMAND_MIN), FLOAT32_MAX).T
    sample[-4:] = crc(command_struct(sample)).to_bytes(4, "little")
    return bytes(sample)


def decode_command(data: bytes) -> JointCommand:
    """Decode a command. A motor that is off gets zero gains and torque.

    Args:
        data: The CDR sample.

    Returns:
        The joint command, of mode MODE_SERVO.

    Raises:
        WireError: The sample is not a valid command.
    """
    _check("command", data, COMMAND_BYTES, command_struct)
    if data[_HEAD_AT:_LEVEL_AT] != HEAD or data[_LEVEL_AT] != LOW_LEVEL:
        found, expected = data[_HEAD_AT : _LEVEL_AT + 1].hex(), (HEAD + bytes([LOW_LEVEL])).hex()
        raise WireError(f"command: head and level_flag are {found}, expected {expected}: the low level")
    numbers = _command_numbers(data).T
    require_finite_command(numbers, _location)  # before the cast, which warns of NaN
    off = commanded_modes(data) == MOTOR_OFF
    q, dq, tau, kp, kd = numbers.astype(float)
    no_position, no_velocity = q >= POSITION_OFF, dq >= VELOCITY_OFF
    return JointCommand(
        q=np.where(no_position, 0.0, q),
        dq=np.where(no_velocity, 0.0, dq),
        tau=np.where(off, 0.0, tau),
        kp=np.where(no_position | off, 0.0, kp),
        kd=np.where(no_velocity | off, 0.0, kd),
    )


def commanded_modes(data: bytes) -> NDArray[np.uint8]:
    """Return the mode of each motor in a command.

    Args:
        data: A sample of the right length.

    Returns:
        Modes, (12,).

    Raises:
        WireError: A mode is unknown.
    """
    modes: NDArray[np.uint8] = np.frombuffer(data, np.uint8)[_COMMAND_MODES_AT[:JOINTS]]
    if modes.max() > MOTOR_SERVO:
        i = int(modes.argmax())
        raise WireError(
            f"command: mode of motor {i} is {modes[i]}, expected {MOTOR_OFF} (off) or {MOTOR_SERVO} (servo)"
        )
    return modes


def encode_state(state: BoardState) -> bytes:
    """Encode a board state, with values clamped to the range of their fields.

    Redundant fields are derived: roll, pitch and yaw, raw angles and speeds, estimated foot forces.
    Fields without a counterpart in the record, such as joint accelerations, are 0.

    Args:
        state: The state; `motor_error` is the number of packets that each motor lost.

    Returns:
        The CDR sample, STATE_BYTES long.

    Raises:
        WireError: A number is not finite.
    """
    robot = state.robot
    clipped = state_numbers(robot, _location)
    sample = bytearray(STATE_BYTES)
    sample[: len(HEADER)] = HEADER
    sample[_HEAD_AT : _LEVEL_AT + 1] = HEAD + bytes([LOW_LEVEL])
    fields = np.frombuffer(sample, _STATE)
    for field in ("quaternion", "angular_velocity", "linear_acceleration"):
        fields[field] = clipped[field]
    fields["rpy"] = roll_pitch_yaw(clipped["quaternion"])
    fields["imu_temperature"] = state.imu_temperature
    fields["foot_force"] = fields["foot_force_estimate"] = np.clip(
        np.trunc(clipped["foot_force"]), -(2**15), 2**15 - 1
    )
    fields["tick"] = robot.tick
    fields["remote"] = np.void(encode_remote(state.remote))
    if state.battery is not None:
        battery = state.battery
        fields["charge"], fields["voltage"], fields["current"] = (
            battery.charge,
            battery.voltage,
            battery.current,
        )
    motors = fields["motors"][0, :JOINTS]
    motors["q"] = motors["q_raw"] = clipped["q"]
    motors["dq"] = motors["dq_raw"] = clipped["dq"]
    motors["tau"], motors["lost"] = clipped["tau"], state.motor_error
    motors["temperature"] = state.temperature
    np.frombuffer(sample, np.uint8)[_STATE_MODES_AT[:JOINTS]] = state.motor_mode
    sample[-4:] = crc(state_struct(sample)).to_bytes(4, "little")
    return bytes(sample)


def decode_state(data: bytes) -> BoardState:
    """Decode a state.

    Args:
        data: The CDR sample.

    Returns:
        The state; `motor_error` is the number of packets that each motor lost.

    Raises:
        WireError: The sample is not a valid state.
    """
    _check("state", data, STATE_BYTES, state_struct)
    fields = np.frombuffer(data, _STATE)[0]
    motors = fields["motors"][:JOINTS]
    joints = np.array((motors["q"], motors["dq"], motors["tau"]))
    imu = np.frombuffer(data, "<f4", _IMU_NUMBERS, offset=_IMU_AT)
    if np.count_nonzero(np.isfinite(joints)) + np.count_nonzero(np.isfinite(imu)) < joints.size + imu.size:
        found = dict(zip(("q", "dq", "tau"), joints, strict=True)) | {
            field: fields[field] for field in ("quaternion", "angular_velocity", "linear_acceleration")
        }
        raise not_finite("state", found, _location)
    q, dq, tau = joints.astype(float)
    imu = imu.astype(float)
    robot = RobotState(
        time=0.0,
        tick=int(fields["tick"]),
        q=q,
        dq=dq,
        tau=tau,
        quaternion=imu[:4],
        angular_velocity=imu[4:7],
        linear_acceleration=imu[7:],
        foot_force=fields["foot_force"].astype(float),
    )
    return BoardState(
        robot=robot,
        motor_mode=np.frombuffer(data, np.uint8)[_STATE_MODES_AT[:JOINTS]],
        motor_error=motors["lost"].copy(),
        temperature=motors["temperature"].copy(),
        imu_temperature=int(fields["imu_temperature"]),
        remote=decode_remote(fields["remote"].tobytes()),
        battery=Battery(int(fields["charge"]), float(fields["voltage"]), float(fields["current"])),
    )


def _check(kind: str, data: bytes, length: int, struct: Any) -> None:
    """Check length, encapsulation header and CRC; raise WireError if one is wrong."""
    if len(data) != length:
        raise WireError(f"{kind}: {len(data)} bytes, expected {length}", LENGTH)
    if data[:4] != HEADER:
        raise WireError(
            f"{kind}: encapsulation header is {data[:4].hex()}, expected {HEADER.hex()}: little-endian CDR"
        )
    check_crc(kind, data[-4:], struct(data))


def _command_numbers(sample: bytes | bytearray) -> NDArray[np.float32]:
    """Return a view of q, dq, tau, kp and kd of the joints, (12, 5)."""
    return np.ndarray((JOINTS, len(_COMMAND_MIN)), "<f4", sample, _COMMAND_MOTORS_AT, (_COMMAND_STRIDE, 4))


def _location(field: str, i: int) -> str:
    """Return the place of the i-th number of a field: a motor, foot or axis."""
    if field == "foot_force":
        return f"foot {i}"
    if field == "quaternion":
        return f"axis {'wxyz'[i]}"
    return f"axis {'xyz'[i]}" if field in ("angular_velocity", "linear_acceleration") else f"motor {i}"
