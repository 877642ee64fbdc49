"""Messages as bytes: the same as those that the middleware writes and reads."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
import pytest

from quadvel_dds.messages import deserialize, message_class, serialize
from quadvel_description.state import JointCommand, RobotState
from quadvel_nodes import flat_messages as flat
from quadvel_nodes.messages import MessageError, NotFiniteError, read_low_cmd, read_low_state, write_low_state

STAMP = (12, 250_000_000)
RNG = np.random.default_rng(0)
STATE = RobotState(
    12.25, 4_000_000_000, *RNG.normal(size=(3, 12)), np.array([0.5, -0.5, 0.5, 0.5]), *RNG.normal(size=(2, 3)),
    RNG.normal(size=4),
)  # fmt: skip
COMMAND = JointCommand(*RNG.normal(size=(5, 12)), mode=10, tick=77)  # type: ignore[misc]
ESTIMATE = RNG.normal(size=3), RNG.normal(size=3), RNG.normal(size=36)


def _assert_equal(found: Any, expected: Any) -> None:
    for name, value in attrs.asdict(expected, recurse=False).items():
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)


def test_a_state_is_written_and_read_as_the_middleware_does() -> None:
    data = flat.encode_low_state(STAMP, STATE)
    message = deserialize(data, "quadvel_msgs/msg/LowState")
    assert (message.stamp.sec, message.stamp.nanosec) == STAMP
    again = message_class("quadvel_msgs/msg/LowState")(stamp=message.stamp)
    write_low_state(STATE, again)
    assert bytes(serialize(again)) == data
    stamp, state = flat.decode_low_state(data)
    assert stamp == STAMP
    _assert_equal(state, read_low_state(message))


def test_a_command_is_written_and_read_as_the_middleware_does() -> None:
    data = flat.encode_low_cmd(STAMP, COMMAND)
    message = deserialize(data, "quadvel_msgs/msg/LowCmd")
    assert (message.stamp.sec, message.stamp.nanosec) == STAMP
    _assert_equal(flat.decode_low_cmd(bytes(serialize(message))), read_low_cmd(message))


@pytest.mark.parametrize("frame", ["", "base", "base_link", "base_link_of_it"])
def test_an_estimate_is_written_and_read_as_the_middleware_does(frame: str) -> None:
    data = flat.encode_estimate(STAMP, frame, *ESTIMATE)
    message = deserialize(data, "geometry_msgs/msg/TwistWithCovarianceStamped")
    assert message.header.frame_id == frame
    np.testing.assert_array_equal(message.twist.covariance, ESTIMATE[2])
    assert message.twist.twist.angular.z == ESTIMATE[1][2]
    time, velocity = flat.decode_estimate(bytes(serialize(message)))
    assert time == 12.25
    np.testing.assert_array_equal(velocity, ESTIMATE[0])


def test_other_bytes_are_refused() -> None:
    data = flat.encode_low_state(STAMP, STATE)
    for wrong in (b"", data[:100], b"\x00\x00" + data[2:]):
        with pytest.raises(MessageError):
            flat.decode_low_state(wrong)
    with pytest.raises(MessageError):
        flat.decode_estimate(data[:12] + b"\xff\xff\xff\xff" + data[16:])


def test_numbers_that_are_not_finite_are_refused_by_name() -> None:
    for field in ("q", "foot_force"):
        broken = attrs.evolve(STATE, **{field: np.full_like(getattr(STATE, field), np.nan)})
        with pytest.raises(NotFiniteError, match=f"{field} holds nan"):
            flat.decode_low_state(flat.encode_low_state(STAMP, broken))
    with pytest.raises(NotFiniteError, match="linear holds inf"):
        flat.decode_estimate(flat.encode_estimate(STAMP, "base", [0.0, np.inf, 0.0], *ESTIMATE[1:]))
