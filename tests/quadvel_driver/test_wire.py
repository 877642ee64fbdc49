"""The packets byte for byte: golden vectors, round trips, and everything that must be refused."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand
from quadvel_driver import wire
from quadvel_driver.board_state import BoardState, Button, Remote
from quadvel_driver.packets import WireError
from tests.helpers.boards import equal, random_state

# The formats, written down a second time: struct instead of NumPy, as the fact sheet gives them.
MOTOR_COMMAND = "BffhhhIII"
COMMAND = "<BHHIB" + 20 * MOTOR_COMMAND + "12B40sI"
STATE = "<BHHIB" + "4f3f3f3fb" + 20 * "BffhhffhbII" + "4h4hI40sI"
SEED_OF_GOLDEN = JointCommand(
    q=np.full(12, 0.5), tau=np.full(12, -1.6), kp=np.full(12, 150.0), kd=np.full(12, 4.0)
)


def slow_crc(data: bytes) -> int:
    """The CRC bit by bit, from its polynomial."""
    crc = 0xFFFFFFFF
    for (word,) in struct.iter_unpack("<I", data):
        for bit in range(31, -1, -1):
            carry = crc >> 31 ^ word >> bit & 1
            crc = crc << 1 & 0xFFFFFFFF ^ (0x04C11DB7 if carry else 0)
    return crc


def some_state(seed: int = 0) -> BoardState:
    return random_state(seed, MODE_SERVO, imu_temperature=41)


COMMAND_PACKET = wire.encode_command(SEED_OF_GOLDEN)
STATE_PACKET = wire.encode_state(some_state())


@pytest.mark.parametrize(
    ("data", "crc"),
    [
        (bytes(4), 0xC704DD7B),
        (struct.pack("<I", 0x12345678), 0xDF8A8A2B),
        (bytes([1, 2, 3, 4]), 0x1DABE74F),
        (bytes(604), 0xC0038EC9),
        (bytes(764), 0xC54DCDDD),
    ],
)
def test_the_crc_gives_the_golden_values(data: bytes, crc: int) -> None:
    assert wire.crc(data) == crc


@given(st.binary(min_size=4, max_size=800).map(lambda data: data[: len(data) // 4 * 4]))
def test_the_crc_is_the_one_that_its_polynomial_gives_bit_by_bit(data: bytes) -> None:
    assert wire.crc(data) == slow_crc(data)


def test_the_crc_of_the_vendors_untouched_command_is_the_one_that_the_vendor_computes() -> None:
    motor = (MODE_SERVO, 2.146e9, 16000.0, 0, 0, 0, 0, 0, 0)
    packet = struct.pack(COMMAND, 0xFF, 0, 0, 0, 0, *(20 * motor), *bytes(12), bytes(40), 0)
    assert packet.startswith(b"\xff" + bytes(9) + bytes.fromhex("0ab9d2ff4e00007a46"))
    assert wire.crc(packet[:604]) == 0x1359692F


def test_a_command_is_the_packet_that_the_vendors_library_sends_byte_for_byte() -> None:
    motor = (MODE_SERVO, 0.5, 0.0, -409, 4800, 64, 0, 0, 0)
    body = struct.pack(COMMAND, 0xFF, 0, 0, 0, 0, *(12 * motor), *(8 * 9 * [0]), *bytes(12), bytes(40), 0)
    assert wire.encode_command(SEED_OF_GOLDEN) == body + struct.pack("<I", 0x0A82B497)


def test_a_state_is_read_from_where_the_format_has_it() -> None:
    motors = []
    for i in range(20):
        motors += [10, 0.1 * i, 0.2 * i, 0, 256 * i, 9.0, 9.0, 9, 30 + i, 100 + i, 0]
    remote = struct.pack("<2sHfffff16x", b"\x55\x51", 0x0102, 0.5, -0.25, 0.125, 9.0, 1.0)
    imu = (1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3, 0.0, 0.0, 9.81, 0.4, 0.5, 0.6, 37)
    body = struct.pack(STATE, 0xFF, 1, 2, 3, 4, *imu, *motors, 11, -12, 13, 14, 5, 6, 7, 8, 123456, remote, 0)
    state = wire.decode_state(body + struct.pack("<I", wire.crc(body[:764])))
    robot = state.robot
    np.testing.assert_allclose(robot.q, 0.1 * np.arange(12), rtol=1e-6)
    np.testing.assert_allclose(robot.dq, 0.2 * np.arange(12), rtol=1e-6)
    np.testing.assert_array_equal(robot.tau, np.arange(12))
    np.testing.assert_array_equal(robot.quaternion, [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(robot.angular_velocity, [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(robot.linear_acceleration, [0.0, 0.0, 9.81], rtol=1e-6)
    np.testing.assert_array_equal(robot.foot_force, [11, -12, 13, 14])
    assert robot.tick == 123456
    np.testing.assert_array_equal(state.temperature, 30 + np.arange(12))
    np.testing.assert_array_equal(state.motor_mode, 10)
    np.testing.assert_array_equal(state.motor_error, 100 + np.arange(12))
    assert state.imu_temperature == 37
    assert state.remote == Remote(Button.A | Button.L1, lx=0.5, rx=-0.25, ry=0.125, ly=1.0)


@given(st.integers(0, 2**31))
def test_a_state_comes_back_as_it_was(seed: int) -> None:
    state = some_state(seed)
    packet = wire.encode_state(state)
    assert len(packet) == wire.STATE_BYTES
    assert equal(wire.decode_state(packet), state)


def arrays(low: float, high: float) -> st.SearchStrategy[np.ndarray]:
    return st.lists(st.floats(low, high), min_size=12, max_size=12).map(np.array)


@given(arrays(-4, 4), arrays(-40, 40), arrays(-127, 127), arrays(0, 1023), arrays(0, 2047))
def test_a_command_comes_back_within_the_resolution_of_the_packet(
    q: np.ndarray, dq: np.ndarray, tau: np.ndarray, kp: np.ndarray, kd: np.ndarray
) -> None:
    for mode in (MODE_SERVO, MODE_DAMPING):
        back = wire.decode_command(wire.encode_command(JointCommand(q, dq, tau, kp, kd, mode)))
        assert back.mode == mode
        np.testing.assert_allclose(back.q, q, rtol=1e-6, atol=1e-30)
        np.testing.assert_allclose(back.dq, dq, rtol=1e-6, atol=1e-30)
        for sent, got, step in ((tau, back.tau, 1 / 256), (kp, back.kp, 1 / 32), (kd, back.kd, 1 / 16)):
            assert (np.abs(got) <= np.abs(sent) + 1e-4).all()  # towards zero, never more than commanded
            np.testing.assert_allclose(got, sent, atol=step + 1e-4)


@given(st.floats(allow_nan=False, allow_infinity=False), st.sampled_from(["q", "dq", "tau", "kp", "kd"]))
def test_what_a_field_cannot_hold_is_clamped_and_never_wraps(value: float, field: str) -> None:
    bounds = {"q": (-100, 100), "dq": (-1e3, 1e3), "tau": (-128, 128), "kp": (0, 1024), "kd": (0, 2048)}
    command = JointCommand(kp=np.ones(12), kd=np.ones(12))
    getattr(command, field)[4] = value
    got = getattr(wire.decode_command(wire.encode_command(command)), field)[4]
    low, high = bounds[field]
    assert got == pytest.approx(np.clip(value, low, high), abs=0.07, rel=1e-6)


def test_200_newton_metres_do_not_become_minus_56() -> None:
    command = JointCommand(tau=np.full(12, 200.0))
    assert wire.decode_command(wire.encode_command(command)).tau == pytest.approx(
        np.full(12, 128.0), abs=0.01
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["q", "dq", "tau", "kp", "kd"])
def test_a_command_that_is_not_finite_is_refused_by_name(field: str, value: float) -> None:
    command = JointCommand()
    getattr(command, field)[5] = value
    with pytest.raises(WireError, match=rf"^command: {field} of FL_calf_joint is {value}, expected a finite"):
        wire.encode_command(command)


@pytest.mark.parametrize("field", ["q", "dq", "tau", "angular_velocity", "quaternion", "foot_force"])
def test_a_state_that_is_not_finite_is_not_sent(field: str) -> None:
    state = some_state()
    getattr(state.robot, field)[1] = np.nan
    with pytest.raises(WireError, match=rf"^state: {field} of .* is nan, expected a finite number"):
        wire.encode_state(state)


@pytest.mark.parametrize(
    ("offset", "text"),
    [
        (63 + 32 * 3 + 1, "state: q of FL_hip_joint is nan"),
        (63 + 32 * 3 + 5, "state: dq of FL_hip_joint is nan"),
        (10 + 8, "state: quaternion of axis y is nan"),
        (26, "state: angular_velocity of axis x is nan"),
        (46, "state: linear_acceleration of axis z is nan"),
    ],
)
def test_a_received_number_that_is_not_finite_is_refused_by_name(offset: int, text: str) -> None:
    packet = bytearray(STATE_PACKET)
    packet[offset : offset + 4] = struct.pack("<f", np.nan)
    with pytest.raises(WireError, match=text):
        wire.decode_state(sealed(packet))


def test_a_remote_whose_sticks_are_not_numbers_counts_as_switched_off() -> None:
    packet = bytearray(STATE_PACKET)
    packet[723 + 4 : 723 + 8] = struct.pack("<f", np.nan)
    assert wire.decode_state(sealed(packet)).remote == Remote()


def sealed(packet: bytearray) -> bytes:
    """With the CRC that belongs to it."""
    covered = len(packet) // 4 * 4 - 4
    packet[-4:] = struct.pack("<I", wire.crc(bytes(packet[:covered])))
    return bytes(packet)


@pytest.mark.parametrize(
    ("decode", "packet"), [(wire.decode_command, COMMAND_PACKET), (wire.decode_state, STATE_PACKET)]
)
def test_a_packet_with_any_one_bit_flipped_is_refused(decode, packet: bytes) -> None:
    """The CRC alone would let flips in the last bytes before it pass: it does not cover them."""
    decode(packet)
    for bit in range(8 * len(packet)):
        flipped = bytearray(packet)
        flipped[bit // 8] ^= 1 << bit % 8
        with pytest.raises(WireError, match=r"CRC|reserve"):
            decode(bytes(flipped))


NUMBER = st.floats(allow_nan=False, allow_infinity=False)
LARGEST = float(np.finfo(np.float32).max)


@st.composite
def states(draw: st.DrawFn, number: st.SearchStrategy[float] = NUMBER) -> BoardState:
    """Any record of such numbers, also impossible ones."""
    state = some_state(draw(st.integers(0, 1000)))
    for field in ("q", "dq", "tau", "quaternion", "angular_velocity", "linear_acceleration", "foot_force"):
        values = getattr(state.robot, field)
        values[:] = draw(st.lists(number, min_size=len(values), max_size=len(values)))
    return state


@pytest.mark.filterwarnings("error")
@settings(max_examples=40)
@given(states())
def test_any_finite_state_comes_back_clamped_to_what_its_fields_hold(state: BoardState) -> None:
    sent, got = state.robot, wire.decode_state(wire.encode_state(state)).robot
    for field in ("q", "dq", "quaternion", "angular_velocity", "linear_acceleration"):
        expected = np.clip(getattr(sent, field), -LARGEST, LARGEST)
        np.testing.assert_allclose(getattr(got, field), expected, rtol=1e-6, atol=1e-40)
    np.testing.assert_allclose(got.tau, np.clip(sent.tau, -128.0, 127.996), atol=1 / 256 + 1e-9)
    np.testing.assert_allclose(got.foot_force, np.clip(sent.foot_force, -(2.0**15), 2.0**15 - 1), atol=1.0)


@settings(max_examples=100)
@given(states(st.floats(-10, 10)), st.integers(0, 8 * wire.STATE_BYTES - 1))
def test_whatever_the_state_a_flipped_bit_is_noticed(state: BoardState, bit: int) -> None:
    packet = bytearray(wire.encode_state(state))
    packet[bit // 8] ^= 1 << bit % 8
    with pytest.raises(WireError, match=r"CRC|reserve"):
        wire.decode_state(bytes(packet))


@pytest.mark.filterwarnings("error")
@settings(max_examples=200)
@given(st.data(), st.sampled_from([COMMAND_PACKET, STATE_PACKET]))
def test_any_bytes_with_the_right_crc_are_finite_numbers_or_refused(
    data: st.DataObject, packet: bytes
) -> None:
    """Malicious content with a valid CRC."""
    length = len(packet) - 12
    start = data.draw(st.integers(0, length))
    forged = bytearray(packet)
    forged[start:length] = data.draw(st.binary(min_size=length - start, max_size=length - start))
    decode = wire.decode_command if packet is COMMAND_PACKET else wire.decode_state
    try:
        record = decode(sealed(forged))
    except WireError as error:
        assert "expected" in str(error)  # noqa: PT017
        return
    robot = getattr(record, "robot", record)
    assert np.isfinite((robot.q, robot.dq, robot.tau)).all()


@settings(max_examples=200)
@given(st.sampled_from([COMMAND_PACKET, STATE_PACKET]), st.data())
def test_a_packet_with_some_bytes_changed_is_refused(packet: bytes, data: st.DataObject) -> None:
    changed = bytearray(packet)
    for _ in range(data.draw(st.integers(1, 4))):
        changed[data.draw(st.integers(0, len(packet) - 1))] = data.draw(st.integers(0, 255))
    if bytes(changed) != packet:
        with pytest.raises(WireError):
            (wire.decode_command if len(packet) == 610 else wire.decode_state)(bytes(changed))


@given(st.binary(max_size=1000))
def test_random_bytes_are_refused_in_one_sentence(data: bytes) -> None:
    for decode in (wire.decode_command, wire.decode_state):
        with pytest.raises(WireError, match=r"^(command|state): .*expected"):
            decode(data)


@pytest.mark.parametrize(
    ("decode", "length", "text"),
    [
        (wire.decode_state, 684, r"684 bytes, the state of firmware 3.1 \(aliengo_sdk 1.2\), expected 771"),
        (
            wire.decode_command,
            540,
            r"540 bytes, the command of firmware 3.1 \(aliengo_sdk 1.2\), expected 610",
        ),
        (wire.decode_state, 807, "807 bytes, the state of a Go1, expected 771"),
        (wire.decode_state, 891, "891 bytes, the state as the SDK's programs hold it, expected 771"),
        (wire.decode_state, 610, "610 bytes, expected 771"),
        (wire.decode_state, 0, "0 bytes, expected 771"),
    ],
)
def test_another_format_is_refused_by_name(decode, length: int, text: str) -> None:
    with pytest.raises(WireError, match=text):
        decode(bytes(length))


def test_a_command_for_the_high_level_is_refused() -> None:
    packet = bytearray(COMMAND_PACKET)
    packet[0] = 0x00
    with pytest.raises(WireError, match="command: levelFlag is 0x00, expected 0xFF"):
        wire.decode_command(sealed(packet))


def test_motors_may_be_asked_for_different_modes() -> None:
    packet = bytearray(COMMAND_PACKET)
    packet[10 + 27 * 4] = MODE_DAMPING
    data = sealed(packet)
    command, whole = wire.decode_command(data), wire.decode_command(COMMAND_PACKET)
    there = np.arange(12) == 4
    assert command.mode == MODE_SERVO
    assert (command.kp[there], command.tau[there], command.dq[there]) == (0.0, 0.0, 0.0)
    assert command.kd[there] == whole.kd[there]
    for field in ("q", "tau", "kp", "kd"):
        np.testing.assert_array_equal(getattr(command, field)[~there], getattr(whole, field)[~there])
    np.testing.assert_array_equal(wire.commanded_modes(data), np.where(there, MODE_DAMPING, MODE_SERVO))


def test_what_a_state_says_twice_agrees() -> None:
    state = some_state()
    state.robot.quaternion = np.array([np.cos(0.3), 0.0, np.sin(0.3), 0.0])
    body = struct.unpack(STATE, wire.encode_state(state)[:-4])
    motors = np.array(body[19 : 19 + 12 * 11], float).reshape(12, 11)
    assert body[0] == 0xFF
    assert body[15:18] == pytest.approx((0.0, 0.6, 0.0), abs=1e-6)
    np.testing.assert_allclose(motors[:, 5], state.robot.q, rtol=1e-6)
    np.testing.assert_allclose(motors[:, 6], state.robot.dq, rtol=1e-6)
    np.testing.assert_array_equal(body[-7:-3], state.robot.foot_force)


def test_a_command_of_an_unknown_mode_is_refused() -> None:
    packet = bytearray(COMMAND_PACKET)
    packet[10 + 27 * 4] = 3
    with pytest.raises(WireError, match="command: mode of FL_thigh_joint is 3, expected 0 or 10"):
        wire.decode_command(sealed(packet))
    with pytest.raises(WireError, match="command: mode is 3, expected 0 or 10"):
        wire.encode_command(JointCommand(mode=3))


def test_the_numbers_that_switch_a_term_off_take_its_gain_away() -> None:
    packet = bytearray(COMMAND_PACKET)
    packet[10 + 1 : 10 + 9] = struct.pack("<ff", 2.146e9, 16000.0)
    command = wire.decode_command(sealed(packet))
    assert (command.q[0], command.dq[0], command.kp[0], command.kd[0]) == (0.0, 0.0, 0.0, 0.0)
    assert (command.kp[1], command.kd[1]) == (150.0, 4.0)


@pytest.mark.filterwarnings("error")
def test_a_signaling_nan_is_refused_without_a_warning() -> None:
    for decode, packet, place in (
        (wire.decode_state, STATE_PACKET, 64),
        (wire.decode_command, COMMAND_PACKET, 11),
    ):
        changed = bytearray(packet)
        changed[place : place + 4] = bytes.fromhex("0100a07f")
        with pytest.raises(WireError, match="q of FR_hip_joint is nan"):
            decode(sealed(changed))
