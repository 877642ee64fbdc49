"""What a picture makes of messages, wherever they come from."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_view.operator import Operator
from quadvel_view.panel import panel
from quadvel_view.picture import TOPICS, Ground, RobotPicture
from tests.helpers.robots import ALIENGO

from .conftest import message, odometry

NAN = float("nan")
STATE = "quadvel_msgs/msg/ControllerState"


def test_joints_are_taken_by_their_names() -> None:
    picture = RobotPicture(ALIENGO)
    names = list(reversed(JOINT_NAMES))
    angles, torques = np.linspace(0.0, 1.1, 12), np.linspace(5.0, -6.0, 12)
    joints = message("sensor_msgs/msg/JointState", name=names, position=angles, effort=torques)
    picture.update("/joint_states", joints, 0.0)
    assert picture.q == pytest.approx(angles[::-1])
    assert picture.torque == pytest.approx(torques[::-1])


def test_a_scan_lies_where_laser_and_robot_are() -> None:
    picture = RobotPicture(ALIENGO)
    picture.update("/odom", odometry(10.0, 5.0), 0.0)
    laser = message("geometry_msgs/msg/TransformStamped", child_frame_id="laser")
    laser.header.frame_id = "base_link"
    laser.transform.translation.x, laser.transform.translation.z = 0.25, 0.1
    picture.update("/tf_static", message("tf2_msgs/msg/TFMessage", transforms=[laser]), 0.0)
    scan = message(
        "sensor_msgs/msg/LaserScan",
        angle_min=0.0,
        angle_increment=np.pi / 2,
        range_min=0.1,
        range_max=10.0,
        ranges=np.array([2.0, 3.0, np.inf], np.float32),
    )
    scan.header.frame_id = "laser"
    picture.update("/scan", scan, 0.0)
    assert picture.scan == pytest.approx(np.array([[12.25, 5.0, 0.5], [10.25, 8.0, 0.5]]))


def test_the_way_behind_has_a_point_every_few_centimetres() -> None:
    picture = RobotPicture(ALIENGO)
    for x in np.arange(0.0, 1.0, 0.01):
        picture.update("/odom", odometry(x, 0.0), 0.0)
    steps = np.diff(np.array(picture.trail)[:, 0])
    assert steps.min() > 0.05
    assert steps.max() < 0.07


def test_low_state_counts_where_nothing_better_comes() -> None:
    picture = RobotPicture(ALIENGO)
    low = message("quadvel_msgs/msg/LowState", q=np.full(12, 0.3, np.float32))
    low.orientation_wxyz = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
    picture.update("/low_state", low, 0.0)
    assert picture.q == pytest.approx(np.full(12, 0.3))
    joints = message("sensor_msgs/msg/JointState", name=list(JOINT_NAMES), position=np.zeros(12))
    picture.update("/joint_states", joints, 1.0)
    picture.update("/low_state", low, 1.1)
    assert picture.q == pytest.approx(np.zeros(12))


def test_a_fault_is_the_first_lamp_and_a_silent_node_is_told() -> None:
    picture = RobotPicture(ALIENGO)
    state = message("quadvel_msgs/msg/ControllerState", mode_name="fault", fault="tilted", reason="it fell")
    status = message("diagnostic_msgs/msg/DiagnosticStatus", name="estimator", message="estimating", level=0)
    other = message("diagnostic_msgs/msg/DiagnosticStatus", name="controller", message="fine", level=0)
    picture.update("/diagnostics", message("diagnostic_msgs/msg/DiagnosticArray", status=[status]), 0.0)
    picture.update("/diagnostics", message("diagnostic_msgs/msg/DiagnosticArray", status=[other]), 9.0)
    picture.update("/controller/state", state, 9.0)
    lamps = panel(picture, Operator(), 9.1)["lamps"]
    assert lamps[0] == {"name": "tilted", "level": "error", "text": "it fell"}
    assert {"name": "estimator", "level": "stale", "text": "no diagnostics for 3 s"} in lamps
    assert panel(picture, Operator(), 10.5)["mode"] == ""


def test_feet_stand_on_the_ground_that_there_is() -> None:
    picture = RobotPicture(ALIENGO)
    assert picture.ground_below_feet()[1] == pytest.approx(
        0.0, abs=1e-3
    )  # in the nominal posture at the nominal height
    corners = [(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0)]
    points = [message("geometry_msgs/msg/Point", x=x, y=y, z=0.1) for x, y in corners]
    picture.update("/ground", message("visualization_msgs/msg/Marker", type=11, points=points), 0.0)
    assert picture.ground_below_feet()[1] == pytest.approx(-0.1, abs=1e-3)
    picture.update("/ground", message("visualization_msgs/msg/Marker", type=11, action=2), 1.0)
    assert picture.ground is None
    assert picture.ground_below_feet()[1] == pytest.approx(0.0, abs=1e-3)


def test_the_ground_between_its_corners_is_the_plane_through_them() -> None:
    slope = Ground(
        np.array([(-8, -8, -1.6), (8, -8, 1.6), (8, 8, 1.6), (-8, -8, -1.6), (8, 8, 1.6), (-8, 8, -1.6)])
    )
    for x, y in ((0.0, 0.0), (3.0, -2.0), (-7.0, 5.0)):
        assert slope.height(x, y) == pytest.approx(0.2 * x)
    assert slope.height(50.0, 0.0) == pytest.approx(1.6)


def test_numbers_that_are_not_there_are_none_and_the_rest_is_shown() -> None:
    picture = RobotPicture(ALIENGO)
    for _ in range(2):  # before the first message, and with one whose numbers are not there yet
        readings = json.loads(json.dumps(panel(picture, Operator(), 0.0), allow_nan=False))
        assert readings["measured"] == readings["commanded"] == [None] * 3
        assert readings["torque"] == [None] * 12
        state = message(STATE, mode_name="stand_up", period_p99_ms=NAN, compute_p99_us=NAN, rate_hz=NAN)
        state.command.linear.x = state.command.linear.y = state.command.angular.z = NAN
        odom = odometry(0.0, 0.0, NAN)
        odom.twist.twist.linear.y = odom.twist.twist.angular.z = NAN
        picture.update("/controller/state", state, 0.0)
        picture.update("/odom", odom, 0.0)
    assert readings["mode"] == "stand_up"
    assert readings["loop"] == {"rate": None, "period": None, "compute": None, "missed": 0}


def test_readings_of_a_silent_robot_are_not_there() -> None:
    picture = RobotPicture(ALIENGO)
    joints = message("sensor_msgs/msg/JointState", name=list(JOINT_NAMES), position=np.zeros(12))
    joints.effort = np.ones(12)
    picture.update("/joint_states", joints, 0.0)
    picture.update("/odom", odometry(0.0, 0.0), 0.0)
    assert None not in panel(picture, Operator(), 0.1)["measured"] + panel(picture, Operator(), 0.1)["torque"]
    late = panel(picture, Operator(), 5.0)
    assert late["measured"] == [None] * 3
    assert late["torque"] == [None] * 12
    assert late["notices"] == ["no message from the robot for 5 s"]


def _cyclic(picture: RobotPicture) -> None:
    loop = [message("geometry_msgs/msg/TransformStamped", child_frame_id=name) for name in ("a", "b")]
    loop[0].header.frame_id, loop[1].header.frame_id = "b", "a"
    picture.update_lazily("/tf_static", lambda: message("tf2_msgs/msg/TFMessage", transforms=loop), 0.0)


@pytest.mark.parametrize(
    ("topic", "make"),
    [
        ("/joint_states", lambda kind: message(kind, name=["elbow"], position=np.zeros(1))),
        ("/joint_states", lambda kind: message(kind, name=list(JOINT_NAMES), position=np.zeros(3))),
        ("/joint_states", lambda kind: message(kind, name=list(JOINT_NAMES), position=np.full(12, NAN))),
        ("/odom", lambda kind: odometry(NAN, 0.0)),
        ("/diagnostics", lambda kind: message(kind, status=[message("diagnostic_msgs/msg/DiagnosticStatus", level=b"")])),
        ("/person_tracker/markers", lambda kind: message(kind, markers=[_marker(3)])),
        ("/ground", lambda kind: _marker(11, points=[message("geometry_msgs/msg/Point")] * 4)),
        ("/scan", lambda kind: message(kind, angle_min=NAN, ranges=np.ones(3, np.float32), range_max=9.0)),
        ("/command", lambda kind: 1 / 0),
    ],
)  # fmt: skip
def test_a_message_that_makes_no_sense_is_refused_and_told(topic: str, make: Callable[[str], Any]) -> None:
    picture = RobotPicture(ALIENGO)
    picture.update_lazily(topic, lambda: make(TOPICS[topic]), 0.0)
    lamps = panel(picture, Operator(), 0.0)["lamps"]
    assert [lamp["name"] for lamp in lamps] == [topic]
    assert np.isfinite(picture.position).all()
    assert np.isfinite(picture.q).all()


def _marker(kind: int, **fields: Any) -> Any:
    marker = message("visualization_msgs/msg/Marker", type=kind, **fields)
    marker.color.r = NAN
    return marker


def test_frames_that_go_round_in_circles_do_not_keep_the_page() -> None:
    picture = RobotPicture(ALIENGO)
    _cyclic(picture)
    scan = message("sensor_msgs/msg/LaserScan", ranges=np.ones(3, np.float32), range_max=9.0)
    scan.header.frame_id = "a"
    picture.update_lazily("/scan", lambda: scan, 0.0)
    assert picture.scan.shape == (3, 3)


def test_the_way_behind_ends_where_odometry_starts_again() -> None:
    picture = RobotPicture(ALIENGO)
    for x in np.arange(0.0, 0.9, 0.06):
        odom = odometry(x, 0.0)
        odom.pose.covariance = np.full(36, (0.1 * x) ** 2)
        picture.update("/odom", odom, 0.0)
    assert len(picture.trail) > 10
    picture.update("/odom", odometry(0.0, 0.0), 0.1)
    assert len(picture.trail) == 1
    picture.update("/odom", odometry(5.0, 0.0), 0.2)  # the robot did not walk there
    assert len(picture.trail) == 1


def test_commands_that_come_late_and_a_pad_that_is_not_followed_are_told() -> None:
    picture, operator = RobotPicture(ALIENGO), Operator()
    picture.update("/command", message("quadvel_msgs/msg/VelocityCommand", source="planner"), 0.0)
    operator.hold(1, (0.5, 0.0, 0.0), 0.0)
    assert panel(picture, operator, 0.1)["notices"] == []
    operator.hold(1, (0.5, 0.0, 0.0), 0.35)
    late, ignored = panel(picture, operator, 0.6)["notices"]
    assert "0.3 s apart" in late or "0.4 s apart" in late
    assert "'planner'" in ignored
    operator.end_hold(1, 0.65)
    assert panel(picture, operator, 0.9)["notices"] == [late]
    operator.hold(1, (0.5, 0.0, 0.0), 60.0)  # a new press is not late
    assert not any("apart" in notice for notice in panel(picture, operator, 60.1)["notices"])
    operator.end_hold(1, 60.1)


def test_a_stopped_robot_says_why_it_does_not_move() -> None:
    picture, operator = RobotPicture(ALIENGO), Operator()
    operator.stop()
    for mode, reason in (
        ("walk", "STOP is latched; the joints are not damped yet"),
        ("passive", "STOP is latched"),
    ):
        picture.update("/controller/state", message(STATE, mode_name=mode, reason="was asked for"), 0.0)
        assert panel(picture, operator, 0.1)["reason"] == reason
