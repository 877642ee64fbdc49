"""Messages made by hand, and a recording of a robot that walks straight on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

import quadvel_dds
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_recordings.definitions import STORE
from quadvel_recordings.recorded import _default
from quadvel_view.picture import TOPICS
from tests.helpers.robots import ALIENGO

quadvel_dds.install()  # before a test module imports rclpy

SPEED = 0.5  # m/s
SECONDS = 3.0


def message(typename: str, **fields: Any) -> Any:
    """A message of this type, its fields at their defaults but for those given."""
    made = STORE.types[typename](*(_default(typename, *field) for field in STORE.fielddefs[typename][1]))
    for name, value in fields.items():
        setattr(made, name, value)
    return made


def odometry(x: float, y: float, speed: float = SPEED) -> Any:
    """Odometry of a robot at this place."""
    odom = message("nav_msgs/msg/Odometry")
    odom.pose.pose.position.x, odom.pose.pose.position.y, odom.pose.pose.position.z = x, y, 0.4
    odom.twist.twist.linear.x = speed
    return odom


@pytest.fixture(scope="session")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """joint_states, odom and controller/state, 50 times a second, as `quadvel record` writes them.

    In the first second there are no times of the loop yet, as when a controller starts.
    """
    path = tmp_path_factory.mktemp("walked") / "walked.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic in ("/joint_states", "/odom", "/controller/state"):
            text, _ = STORE.generate_msgdef(TOPICS[topic], ros_version=2)
            schema = writer.register_schema(TOPICS[topic], "ros2msg", text.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for step in range(round(50 * SECONDS) + 1):
            angles = ALIENGO.nominal_q + 0.1 * np.sin(0.2 * step)
            joints = message("sensor_msgs/msg/JointState", name=list(JOINT_NAMES), position=angles)
            times = {name: float("nan") if step < 50 else 1.0 for name in ("period_p99_ms", "compute_p99_us")}
            state = message("quadvel_msgs/msg/ControllerState", mode_name="walk", **times)
            odom = odometry(SPEED * step / 50, 0.0)
            for topic, one in {"/joint_states": joints, "/odom": odom, "/controller/state": state}.items():
                data = bytes(STORE.serialize_cdr(one, TOPICS[topic]))
                writer.add_message(channels[topic], 1_000_000_000 + 20_000_000 * step, data, 0)
        writer.finish()
    return path
