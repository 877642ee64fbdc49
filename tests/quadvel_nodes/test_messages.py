"""Messages to records and back, and what is refused on the way."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
import pytest

from quadvel_description.state import JointCommand, RobotState
from quadvel_msgs.msg import LowCmd, LowState
from quadvel_nodes.messages import (
    MessageError,
    Refusals,
    read_low_cmd,
    read_low_state,
    write_low_cmd,
    write_low_state,
)


def some_state() -> RobotState:
    rng = np.random.default_rng(0)
    arrays = {"q": 12, "dq": 12, "tau": 12, "angular_velocity": 3, "linear_acceleration": 3, "foot_force": 4}
    quaternion = np.array([0.5, -0.5, 0.5, 0.5])
    values = {name: rng.normal(size=size) for name, size in arrays.items()}
    return RobotState(time=12.25, tick=4_000_000_000, quaternion=quaternion, **values)


def low_state() -> Any:
    message = LowState()
    write_low_state(some_state(), message)
    message.stamp.sec, message.stamp.nanosec = 12, 250_000_000
    return message


def assert_equal(found: Any, expected: Any) -> None:
    for name, value in attrs.asdict(expected, recurse=False).items():
        np.testing.assert_allclose(getattr(found, name), value, rtol=1e-6, err_msg=name)


def test_a_state_survives_the_message() -> None:
    assert_equal(read_low_state(low_state()), some_state())


def test_a_command_survives_the_message() -> None:
    rng = np.random.default_rng(1)
    command = JointCommand(*(rng.normal(size=12) for _ in range(5)), mode=10, tick=77)
    message = LowCmd()
    write_low_cmd(command, message)
    assert_equal(read_low_cmd(message), command)


def test_the_quaternion_is_normalised() -> None:
    message = low_state()
    message.orientation_wxyz = np.array([1.01, 0.0, 0.0, 0.0], np.float32)
    np.testing.assert_array_equal(read_low_state(message).quaternion, [1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("q", [0.0] * 11, "q has 11 numbers, expected 12"),
        ("tau", [np.nan] * 12, "tau holds nan, expected finite numbers"),
        ("linear_acceleration", [0.0, -np.inf, 0.0], "linear_acceleration holds -inf"),
        ("orientation_wxyz", [0.0] * 4, "orientation_wxyz has norm 0, expected a unit quaternion"),
    ],
)
def test_what_is_not_fit_to_use_is_refused_by_name(field: str, value: list[float], sentence: str) -> None:
    message = low_state()
    setattr(message, f"_{field}", value)  # past the check that generated classes may make
    with pytest.raises(MessageError) as refused:
        read_low_state(message)
    assert sentence in str(refused.value)


def test_refusals_are_counted_by_topic_with_the_last_reason() -> None:
    refusals = Refusals()
    for topic, reason in [("low_state", "too old"), ("low_cmd", "nan"), ("low_state", "too short")]:
        refusals.add(topic, reason)
    assert refusals.total == 3
    assert refusals.diagnostic_values() == {
        "refused low_state": "2, last: too short",
        "refused low_cmd": "1, last: nan",
    }


def test_the_refusals_of_the_last_second_are_told_with_their_reason() -> None:
    refusals = Refusals()
    assert not refusals.last_second()
    refusals.add("low_cmd", "q holds nan")
    text = refusals.last_second()
    assert text.startswith("1 message ")
    assert "low_cmd" in text
    assert "q holds nan" in text
    assert not refusals.last_second()
