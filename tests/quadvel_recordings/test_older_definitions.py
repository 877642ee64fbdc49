"""Recordings whose messages were defined otherwise than they are now."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from quadvel_recordings.definitions import STORE
from quadvel_recordings.reading import read_messages

STATE = "quadvel_msgs/msg/ControllerState"
OLDER = """
builtin_interfaces/Time stamp
uint8 mode
string mode_name
float32 temperature
geometry_msgs/Twist command
bool stance
"""
"""As ControllerState may once have been: with few of its fields, and one that has gone."""
NESTED = "geometry_msgs/Pose pose\nquadvel_msgs/ControllerState[2] states\n"
"""A type of somebody else's, around ours"""


def older_store() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(OLDER, STATE))
    store.register(get_types_from_msg(NESTED, "others_msgs/msg/Pair"))
    return store


def older_state(store: Any, vx: float = 0.5) -> Any:
    types = store.types
    zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    ahead = types["geometry_msgs/msg/Vector3"](x=vx, y=0.0, z=0.0)
    return types[STATE](
        stamp=types["builtin_interfaces/msg/Time"](sec=7, nanosec=5),
        mode=3,
        mode_name="walk",
        temperature=40.0,
        command=types["geometry_msgs/msg/Twist"](linear=ahead, angular=zero),
        stance=True,
    )


def write_mcap(
    path: Path, store: Any, message: Any, typename: str = STATE, encoding: str = "ros2msg"
) -> Path:
    """One message on /x, with the definition that the store has of it."""
    text, _ = store.generate_msgdef(typename, ros_version=2)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(typename, encoding, text.encode() if encoding else b"")
        channel = writer.register_channel("/x", "cdr", schema)
        writer.add_message(channel, 0, bytes(store.serialize_cdr(message, typename)), 0)
        writer.finish()
    return path


def only(path: Path) -> Any:
    ((_, _, message),) = read_messages(path, lambda topic, typename: True)
    return message


def check(state: Any) -> None:
    """What was recorded is there, what came later has its default, what has gone is not there."""
    assert type(state) is STORE.types[STATE]
    assert (state.stamp.sec, state.mode, state.mode_name, state.stance) == (7, 3, "walk", True)
    assert state.command.linear.x == 0.5
    assert (state.walk_refusal, state.walk_allowed, state.rate_hz, state.overruns) == ("", False, 0.0, 0)
    assert not hasattr(state, "temperature")


def test_fields_that_came_later_have_their_default(tmp_path: Path) -> None:
    store = older_store()
    check(only(write_mcap(tmp_path / "a.mcap", store, older_state(store))))


def test_a_recording_that_was_cut_off_is_read_by_its_own_definitions_too(tmp_path: Path) -> None:
    store = older_store()
    whole = write_mcap(tmp_path / "a.mcap", store, older_state(store))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-8])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check(only(cut))


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_a_rosbag2_is_read_by_its_own_definitions(tmp_path: Path, storage: StoragePlugin) -> None:
    store = older_store()
    with Rosbag2Writer(tmp_path / "bag", version=9, storage_plugin=storage) as bag:
        connection = bag.add_connection("/x", STATE, typestore=store)
        bag.write(connection, 0, store.serialize_cdr(older_state(store), STATE))
    check(only(tmp_path / "bag"))


def test_older_messages_within_a_foreign_one_are_brought_up_to_date(tmp_path: Path) -> None:
    store = older_store()
    types = store.types
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=3.0),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    pair = types["others_msgs/msg/Pair"](pose=pose, states=[older_state(store)] * 2)
    read = only(write_mcap(tmp_path / "a.mcap", store, pair, "others_msgs/msg/Pair"))
    assert read.pose.position.z == 3.0
    for state in read.states:
        check(state)


def test_a_recording_without_definitions_is_read_by_the_present_ones(tmp_path: Path) -> None:
    twist = STORE.types["geometry_msgs/msg/Twist"]
    vector = STORE.types["geometry_msgs/msg/Vector3"](x=1.0, y=2.0, z=3.0)
    message = twist(linear=vector, angular=vector)
    path = write_mcap(tmp_path / "a.mcap", STORE, message, "geometry_msgs/msg/Twist", encoding="")
    assert only(path) == message


@pytest.mark.parametrize(
    "typename", ["sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState", "quadvel_msgs/msg/LowState"]
)
def test_defaults_are_those_of_ros_2(tmp_path: Path, typename: str) -> None:
    """Of a message that had but one field once, all others: numbers, arrays, texts, and the unit quaternion."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("uint8 once", typename))
    read = only(write_mcap(tmp_path / "a.mcap", store, store.types[typename](once=1), typename))
    assert not hasattr(read, "once")
    again = STORE.deserialize_cdr(STORE.serialize_cdr(read, typename), typename)  # every field is of its type
    for name, _ in STORE.fielddefs[typename][1]:
        np.testing.assert_equal(getattr(again, name), getattr(read, name))
    if typename == "sensor_msgs/msg/Imu":
        assert (read.orientation.w, read.orientation.x, read.header.frame_id) == (1.0, 0.0, "")
        np.testing.assert_array_equal(read.orientation_covariance, np.zeros(9))
