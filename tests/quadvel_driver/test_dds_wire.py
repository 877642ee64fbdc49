"""The samples of rt/lowcmd and rt/lowstate byte for byte: golden CRCs, places, round trips, refusals."""

from __future__ import annotations

import struct

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quadvel_description.state import MODE_DAMPING, JointCommand
from quadvel_driver.board_state import Battery, BoardState, Button, Remote
from quadvel_driver.packets import WireError, crc
from quadvel_driver.unitree_dds import wire
from tests.helpers.boards import equal, random_state

# The C structures whose bytes the CRC covers, and the CDR bodies, written down a second time.
HEAD = "2BBB2I2IH"
MOTOR_COMMAND, MOTOR_STATE = "B3x5f3I", "B3x7fB3xI2I"
COMMAND_STRUCT = "<" + HEAD + "2x" + 20 * MOTOR_COMMAND + "4B40s12s2sBxI"
STATE_STRUCT = "<" + HEAD + "2x" + "4f3f3f3fb3x" + 20 * MOTOR_STATE + "4Bi H2b2b15H" + "4h4hI40sB3xf2b2x2f4HI"
COMMAND_BODY = "<" + HEAD + "Bx" + "5f3I" + 19 * MOTOR_COMMAND + "4B40s12s2sBxII"
STATE_BODY = (
    "<" + HEAD + "2x4f3f3f3fbB2x7fB3xI2I" + 19 * MOTOR_STATE + "4Bi H2b2b15H" + "4h4hI40sB3xf2b2x2f4HII"
)
HEADER = bytes([0, 1, 0, 0])
COMMAND = JointCommand(
    q=np.arange(12) / 8,
    dq=np.arange(12) / 4,
    tau=np.full(12, -1.5),
    kp=np.full(12, 60.0),
    kd=np.full(12, 5.0),
)


def some_state(seed: int = 0) -> BoardState:
    battery = Battery(charge=77, voltage=29.5, current=-2.25)
    return random_state(seed, wire.MOTOR_SERVO, imu_temperature=-3, battery=battery)


COMMAND_SAMPLE, STATE_SAMPLE = wire.encode_command(COMMAND), wire.encode_state(some_state())
DECODERS = [
    pytest.param(wire.decode_command, COMMAND_SAMPLE, wire.command_struct, id="command"),
    pytest.param(wire.decode_state, STATE_SAMPLE, wire.state_struct, id="state"),
]


def sealed(sample: bytes | bytearray) -> bytes:
    """With the CRC that belongs to it."""
    covered = wire.command_struct if len(sample) == wire.COMMAND_BYTES else wire.state_struct
    return bytes(sample[:-4]) + struct.pack("<I", crc(covered(sample)))


def test_the_crc_gives_the_golden_values() -> None:
    assert crc(wire.command_struct(bytes(wire.COMMAND_BYTES))) == 0x4B5A4880
    assert crc(wire.state_struct(bytes(wire.STATE_BYTES))) == 0x85F11EA6
    motors = 20 * (1, 2.146e9, 16000.0, 0.0, 0.0, 0.0, 0, 0, 0)
    head = (0xFE, 0xEF, 0xFF, 0, 0, 0, 0, 0, 0)
    tail = (0, 0, 0, 0, bytes(40), bytes(12), bytes(2), 0, 0)
    untouched = struct.pack(COMMAND_STRUCT, *head, *motors, *tail)
    assert crc(untouched) == 0x06E577CD
    body = struct.pack(COMMAND_BODY, *head, *motors, *tail, 0x06E577CD)
    assert wire.command_struct(HEADER + body) == untouched
    assert not wire.decode_command(HEADER + body).kp.any()


def test_each_field_of_a_command_is_at_its_place() -> None:
    motors: list[float] = []
    for i in range(12):
        motors += [1, i / 8, i / 4, -1.5, 60.0, 5.0, 0, 0, 0]
    body = struct.pack(
        COMMAND_BODY,
        *(0xFE, 0xEF, 0xFF, 0, 0, 0, 0, 0, 0, *motors, *(8 * 9 * [0])),
        *(0, 0, 0, 0, bytes(40), bytes(12), bytes(2), 0, 0, 0),
    )
    assert sealed(HEADER + body) == COMMAND_SAMPLE
    assert equal(wire.decode_command(COMMAND_SAMPLE), COMMAND)


def test_each_field_of_a_state_is_at_its_place() -> None:
    motors: list[float] = []
    for i in range(20):
        motors += [i % 2, 0.125 * i, 0.25 * i, 9.0, 0.5 * i, 9.0, 9.0, 9.0, 30 + i, 100 + i, 7, 7]
    remote = struct.pack("<2sHfffff16x", b"\x55\x51", 0x0102, 0.5, -0.25, 0.125, 9.0, 1.0)
    imu = (1.0, 0.0, 0.0, 0.0, 0.5, 0.25, 0.125, 0.0, 0.0, 9.75, 4.0, 5.0, 6.0, 37)
    numbers = (
        *(0xFE, 0xEF, 0xFF, 0, 1, 2, 3, 4, 5, *imu, *motors),
        *(1, 2, 3, 88, -1500, 12, 1, 2, 3, 4, *range(15)),
        *(11, -12, 13, 14, 5, 6, 7, 8, 123456, remote, 0, 3.0, 40, 41, 28.5, -2.5, 1, 2, 3, 4, 0),
    )
    sample = sealed(HEADER + struct.pack(STATE_BODY, *numbers, 0))
    assert wire.state_struct(sample) == struct.pack(STATE_STRUCT, *numbers)
    state = wire.decode_state(sample)
    robot = state.robot
    np.testing.assert_array_equal(robot.q, 0.125 * np.arange(12))
    np.testing.assert_array_equal(robot.dq, 0.25 * np.arange(12))
    np.testing.assert_array_equal(robot.tau, 0.5 * np.arange(12))
    np.testing.assert_array_equal(robot.quaternion, [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(robot.angular_velocity, [0.5, 0.25, 0.125])
    np.testing.assert_array_equal(robot.linear_acceleration, [0.0, 0.0, 9.75])
    np.testing.assert_array_equal(robot.foot_force, [11, -12, 13, 14])
    assert robot.tick == 123456
    np.testing.assert_array_equal(state.motor_mode, np.arange(12) % 2)
    np.testing.assert_array_equal(state.temperature, 30 + np.arange(12))
    np.testing.assert_array_equal(state.motor_error, 100 + np.arange(12))
    assert state.imu_temperature == 37
    assert state.remote == Remote(Button.A | Button.L1, lx=0.5, rx=-0.25, ry=0.125, ly=1.0)
    assert state.battery == Battery(88, 28.5, -2.5)


def test_a_state_comes_back_as_it_was_sent() -> None:
    for seed in range(5):
        sent = some_state(seed)
        got = wire.decode_state(wire.encode_state(sent))
        got.robot.time = sent.robot.time
        assert equal(got, sent)


@pytest.mark.parametrize(("decode", "sample", "covered"), DECODERS)
def test_a_sample_with_any_one_bit_flipped_is_refused(decode, sample: bytes, covered: object) -> None:
    decode(sample)
    for bit in range(8 * len(sample)):
        flipped = bytearray(sample)
        flipped[bit // 8] ^= 1 << bit % 8
        with pytest.raises(WireError, match=r"CRC|header"):
            decode(bytes(flipped))


@pytest.mark.parametrize(("decode", "sample", "covered"), DECODERS)
@pytest.mark.parametrize("length", [0, 4, 610, 771, 808, 811, 1176])
def test_another_length_is_refused_by_name(decode, sample: bytes, covered: object, length: int) -> None:
    with pytest.raises(WireError, match=f"{length} bytes, expected {len(sample)}") as error:
        decode(bytes(length))
    assert error.value.kind == "length"


def test_a_command_for_the_high_level_is_refused() -> None:
    for place in (4, 5, 6):
        changed = bytearray(COMMAND_SAMPLE)
        changed[place] = 0
        with pytest.raises(WireError, match=r"head and level_flag are .*, expected feefff: the low level"):
            wire.decode_command(sealed(changed))


def test_motors_that_are_off_get_no_torque_and_unknown_modes_are_refused() -> None:
    changed = bytearray(COMMAND_SAMPLE)
    changed[26] = changed[4 + 20 + 36 * 4] = wire.MOTOR_OFF
    command = wire.decode_command(sealed(changed))
    off = np.isin(np.arange(12), (0, 4))
    assert not np.concatenate([command.kp[off], command.kd[off], command.tau[off]]).any()
    np.testing.assert_array_equal(command.kp[~off], 60.0)
    np.testing.assert_array_equal(wire.commanded_modes(bytes(changed)), ~off)
    changed[26] = 10
    with pytest.raises(WireError, match=r"mode of motor 0 is 10, expected 0 \(off\) or 1 \(servo\)"):
        wire.decode_command(sealed(changed))


def test_damping_mode_is_not_sent_because_these_drives_have_none() -> None:
    with pytest.raises(WireError, match=f"mode is {MODE_DAMPING}, expected 10"):
        wire.encode_command(JointCommand.damping())


def test_the_numbers_that_switch_a_term_off_take_its_gain_away() -> None:
    changed = bytearray(COMMAND_SAMPLE)
    changed[28:36] = struct.pack("<ff", 2.146e9, 16000.0)
    command = wire.decode_command(sealed(changed))
    assert (command.q[0], command.dq[0], command.kp[0], command.kd[0]) == (0.0, 0.0, 0.0, 0.0)
    assert (command.kp[1], command.kd[1]) == (60.0, 5.0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("decode", "sample", "place", "text"),
    [
        (wire.decode_command, COMMAND_SAMPLE, 28 + 36 * 5 + 12, "command: kp of motor 5 is nan"),
        (wire.decode_state, STATE_SAMPLE, 84 + 48 * 11, "state: q of motor 11 is nan"),
        (wire.decode_state, STATE_SAMPLE, 44, "state: angular_velocity of axis x is nan"),
        (wire.decode_state, STATE_SAMPLE, 28, "state: quaternion of axis w is nan"),
    ],
)
def test_a_number_that_is_not_finite_is_refused_by_name(decode, sample, place: int, text: str) -> None:
    changed = bytearray(sample)
    changed[place : place + 4] = bytes.fromhex("0100a07f")  # a signaling NaN
    with pytest.raises(WireError, match=text):
        decode(sealed(changed))


def test_a_command_or_state_that_is_not_finite_is_not_sent() -> None:
    with pytest.raises(WireError, match="command: kd of motor 7 is inf"):
        wire.encode_command(attrs.evolve(COMMAND, kd=np.where(np.arange(12) == 7, np.inf, 0.0)))
    state = some_state()
    state.robot.foot_force[2] = np.nan
    with pytest.raises(WireError, match="state: foot_force of foot 2 is nan"):
        wire.encode_state(state)


@settings(max_examples=100)
@given(st.sampled_from([COMMAND_SAMPLE, STATE_SAMPLE]), st.data())
def test_any_content_with_the_right_crc_is_finite_numbers_or_refused(
    sample: bytes, data: st.DataObject
) -> None:
    start = data.draw(st.integers(4, len(sample) - 4))
    forged = sample[:start] + data.draw(st.binary(min_size=len(sample) - start, max_size=len(sample) - start))
    try:
        record = (wire.decode_command if sample is COMMAND_SAMPLE else wire.decode_state)(sealed(forged))
    except WireError as error:
        assert "expected" in str(error)  # noqa: PT017
        return
    robot = getattr(record, "robot", record)
    assert np.isfinite((robot.q, robot.dq, robot.tau)).all()
