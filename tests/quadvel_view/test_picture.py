"""What a picture makes of messages, wherever they come from."""

from __future__ import annotations

import numpy as np
import pytest

from quadvel_description import robot
from quadvel_view.operator import Operator
from quadvel_view.panel import panel
from quadvel_view.picture import RobotPicture

from .conftest import message, odometry


def test_joints_are_taken_by_their_names() -> None:
    picture = RobotPicture()
    names = list(reversed(robot.JOINT_NAMES))
    angles, torques = np.linspace(0.0, 1.1, 12), np.linspace(5.0, -6.0, 12)
    joints = message("sensor_msgs/msg/JointState", name=names, position=angles, effort=torques)
    picture.take("/joint_states", joints, 0.0)
    assert picture.q == pytest.approx(angles[::-1])
    assert picture.torque == pytest.approx(torques[::-1])


def test_a_scan_lies_where_laser_and_robot_are() -> None:
    picture = RobotPicture()
    picture.take("/odom", odometry(10.0, 5.0), 0.0)
    laser = message("geometry_msgs/msg/TransformStamped", child_frame_id="laser")
    laser.header.frame_id = "base_link"
    laser.transform.translation.x, laser.transform.translation.z = 0.25, 0.1
    picture.take("/tf_static", message("tf2_msgs/msg/TFMessage", transforms=[laser]), 0.0)
    scan = message(
        "sensor_msgs/msg/LaserScan",
        angle_min=0.0,
        angle_increment=np.pi / 2,
        range_min=0.1,
        range_max=10.0,
        ranges=np.array([2.0, 3.0, np.inf], np.float32),
    )
    scan.header.frame_id = "laser"
    picture.take("/scan", scan, 0.0)
    assert picture.scan == pytest.approx(np.array([[12.25, 5.0, 0.5], [10.25, 8.0, 0.5]]))


def test_the_way_behind_has_a_point_every_few_centimetres() -> None:
    picture = RobotPicture()
    for x in np.arange(0.0, 1.0, 0.01):
        picture.take("/odom", odometry(x, 0.0), 0.0)
    steps = np.diff(np.array(picture.trail)[:, 0])
    assert steps.min() > 0.05
    assert steps.max() < 0.07


def test_low_state_counts_where_nothing_better_comes() -> None:
    picture = RobotPicture()
    low = message("quadvel_msgs/msg/LowState", q=np.full(12, 0.3, np.float32))
    low.orientation_wxyz = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
    picture.take("/low_state", low, 0.0)
    assert picture.q == pytest.approx(np.full(12, 0.3))
    joints = message("sensor_msgs/msg/JointState", name=list(robot.JOINT_NAMES), position=np.zeros(12))
    picture.take("/joint_states", joints, 1.0)
    picture.take("/low_state", low, 1.1)
    assert picture.q == pytest.approx(np.zeros(12))


def test_a_fault_is_the_first_lamp_and_a_silent_node_is_told() -> None:
    picture = RobotPicture()
    state = message("quadvel_msgs/msg/ControllerState", mode_name="fault", fault="tilted", reason="it fell")
    status = message("diagnostic_msgs/msg/DiagnosticStatus", name="estimator", message="estimating", level=0)
    other = message("diagnostic_msgs/msg/DiagnosticStatus", name="controller", message="fine", level=0)
    picture.take("/diagnostics", message("diagnostic_msgs/msg/DiagnosticArray", status=[status]), 0.0)
    picture.take("/diagnostics", message("diagnostic_msgs/msg/DiagnosticArray", status=[other]), 9.0)
    picture.take("/controller/state", state, 9.0)
    lamps = panel(picture, Operator(), 9.1)["lamps"]
    assert lamps[0] == {"name": "tilted", "level": "error", "text": "it fell"}
    assert {"name": "estimator", "level": "stale", "text": "no diagnostics for 3 s"} in lamps
    assert panel(picture, Operator(), 10.5)["mode"] == ""


def test_feet_stand_on_the_ground_that_there_is() -> None:
    picture = RobotPicture()
    assert picture.floor()[1] == pytest.approx(0.0, abs=1e-3)  # in the nominal posture at the nominal height
    corners = [(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0)]
    points = [message("geometry_msgs/msg/Point", x=x, y=y, z=0.1) for x, y in corners]
    picture.take("/ground", message("visualization_msgs/msg/Marker", type=11, points=points), 0.0)
    assert picture.floor()[1] == pytest.approx(-0.1, abs=1e-3)
    picture.take("/ground", message("visualization_msgs/msg/Marker", type=11, action=2), 1.0)
    assert picture.ground is None
    assert picture.floor()[1] == pytest.approx(0.0, abs=1e-3)
