"""Tests of the node over DDS: topics, lockstep, services, refusals, shutdown."""

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Vector3, Wrench

from quadvel_description.quadruped import GRAVITY, JOINT_NAMES
from quadvel_description.state import JointCommand
from quadvel_nodes.messages import seconds
from tests.helpers.robots import ALIENGO

Start = Callable[..., Any]


def hold(tick: int) -> JointCommand:
    return JointCommand(q=ALIENGO.nominal_q, kp=np.full(12, 150.0), kd=np.full(12, 4.0), tick=tick)


def answer(state: Any) -> JointCommand:
    return hold(state.tick)


def test_lockstep_waits_for_answers_and_tells_the_time(start: Start, peer: Any) -> None:
    start(mode="lockstep", keyframe="stand", answer_timeout=0.2)
    states = peer.heard["low_state"]
    peer.spin_until(lambda: len(states) >= 3)
    assert {state.tick for state in states} == {0}  # no answer: time stands still, the state is sent again
    peer.spin_until(lambda: "waiting for the LowCmd that answers the last state" in peer.diagnosed()[0])
    states.clear()
    peer.answer = answer
    peer.spin_until(lambda: len(states) >= 101)
    ticks = [state.tick for state in states[:101]]
    np.testing.assert_array_equal(np.diff(ticks[1:]), 5)
    for state in states:
        assert seconds(state.stamp) == pytest.approx(1e-3 * state.tick)
    stamps = {(s.stamp.sec, s.stamp.nanosec) for s in states[:101]}
    peer.spin_until(lambda: stamps <= {(m.clock.sec, m.clock.nanosec) for m in peer.heard["/clock"]})
    np.testing.assert_allclose(states[100].q, ALIENGO.nominal_q, atol=0.1)
    odom = peer.heard["ground_truth/odom"][-1]
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_link")
    assert odom.pose.pose.position.z == pytest.approx(ALIENGO.nominal_height, abs=0.03)
    joints = peer.heard["joint_states"][-1]
    assert list(joints.name) == list(JOINT_NAMES)
    assert len(joints.position) == len(joints.velocity) == len(joints.effort) == 12
    assert peer.heard["imu"][-1].linear_acceleration.z == pytest.approx(GRAVITY, abs=2.0)
    links = {transform.child_frame_id for message in peer.heard["/tf"] for transform in message.transforms}
    assert links == {
        name.removesuffix("_joint") for name in JOINT_NAMES
    }  # the estimator publishes the pose of the trunk


def test_in_a_world_the_laser_scans_and_persons_are_told(start: Start, peer: Any) -> None:
    start(mode="fast", world="corridor")
    scans, static = peer.heard["scan"], peer.heard["/tf_static"]
    peer.spin_until(lambda: len(scans) > 5 and "touched" in peer.diagnosed()[1])
    scan = scans[-1]
    assert scan.header.frame_id == "laser"
    assert len(scan.ranges) == 1080
    assert scan.angle_max == pytest.approx(-scan.angle_min) == pytest.approx(np.radians(135.0))
    ranges = np.array(scan.ranges)
    assert ((ranges < scan.range_max) | np.isinf(ranges)).all()
    assert ranges.min() == pytest.approx(1.25, abs=0.1)  # the walls next to the robot
    assert peer.diagnosed()[1]["touched"] == "nothing"
    people = peer.heard["ground_truth/persons"][-1]
    assert people.header.frame_id == "odom"
    assert len(people.poses) == 3
    assert people.poses[0].position.x > 1.8
    frames: dict[str, Any] = {}
    peer.spin_until(
        lambda: (
            frames.update({t.child_frame_id: t for m in static for t in m.transforms}) or "laser" in frames
        )
    )
    mounted = frames["laser"]
    assert (mounted.header.frame_id, mounted.transform.translation.x) == ("base_link", 0.25)
    stamps = np.array([seconds(scan.header.stamp) for scan in scans])
    steps = np.diff(stamps) / 0.05
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_the_services_reset_pause_step_and_push(start: Start, peer: Any) -> None:
    start(mode="lockstep", publish_tf=True)
    states = peer.heard["low_state"]
    peer.answer = answer
    peer.spin_until(lambda: len(states) > 5)

    response = peer.call("step", steps=10)
    assert (response.success, response.message) == (False, "the simulation runs; pause it first")
    assert peer.call("reset", keyframe="stand").success
    response = peer.call("reset", keyframe="sit")
    assert (response.success, response.message) == (
        False,
        "keyframe: found 'sit', expected one of stand, lie",
    )
    response = peer.call("push", body="tail", duration=0.1)
    assert not response.success
    assert response.message.startswith("push: body: found 'tail', expected one of trunk, FR_hip")

    assert peer.call("pause", data=True).success
    peer.spin(0.2)
    count, tick = len(states), states[-1].tick
    force = Wrench(force=Vector3(x=0.0, y=0.0, z=9.0 * ALIENGO.mass * GRAVITY))
    assert peer.call("push", wrench=force, duration=0.01).success
    too_large = peer.call("push", wrench=Wrench(force=Vector3(x=1e9, y=0.0, z=0.0)), duration=0.1)
    assert not too_large.success
    assert "push: force: found 1e+09 N" in too_large.message
    peer.answer = answer
    assert peer.call("step", steps=12).success
    peer.spin_until(
        lambda: len(states) > count and peer.heard["ground_truth/odom"][-1].twist.twist.linear.z > 0.5
    )
    peer.spin_until(lambda: states[-1].tick == tick + 12)
    assert [state.tick - tick for state in states[count:]] == [5, 10, 12]
    assert "base_link" in {t.child_frame_id for message in peer.heard["/tf"] for t in message.transforms}

    assert peer.call("pause", data=False).success
    peer.send(hold(states[-1].tick))
    peer.spin_until(lambda: states[-1].tick > tick + 30)


def test_a_reset_puts_the_robot_on_other_ground(start: Start, peer: Any) -> None:
    start(mode="lockstep", keyframe="stand")
    peer.answer = answer
    states = peer.heard["low_state"]
    peer.spin_until(lambda: len(states) > 5)
    tick = states[-1].tick
    response = peer.call("reset", keyframe="stand", terrain="slope", slope=0.2)
    assert (response.success, response.message) == (
        True,
        "the robot is back in posture stand, on slope ground",
    )
    peer.spin_until(lambda: states[-1].tick > tick + 20)  # time continues
    odom = peer.heard["ground_truth/odom"]
    peer.spin_until(lambda: abs(odom[-1].pose.pose.orientation.y + np.sin(0.1)) < 0.02)  # uphill
    response = peer.call("reset", terrain="swamp")
    assert not response.success
    assert response.message == "Terrain.kind: found 'swamp', expected one of flat, slope, rough"
    response = peer.call("reset", slope=0.1)
    assert not response.success
    assert response.message.startswith("slope: found 0.1 rad without a terrain")
    assert peer.call("reset", keyframe="stand", terrain="flat").success
    peer.spin_until(lambda: abs(odom[-1].pose.pose.orientation.y) < 0.02)


def test_bad_commands_are_refused_counted_and_named(start: Start, peer: Any) -> None:
    start(mode="realtime")
    states = peer.heard["low_state"]
    peer.spin_until(lambda: len(states) > 60)
    bad = (
        ({"q": np.full(12, np.nan, np.float32)}, "q holds nan, expected finite numbers"),
        ({"tick": states[0].tick}, "expected at most 100 ms"),
        ({"mode": 3}, "mode is 3, expected 0 or 10"),
    )
    for count, (changes, reason) in enumerate(bad, start=1):
        peer.send(hold(states[-1].tick), **changes)
        text = f"{count}, last: "
        peer.spin_until(lambda: peer.diagnosed()[1].get("refused low_cmd", "").startswith(text))  # noqa: B023
        assert reason in peer.diagnosed()[1]["refused low_cmd"]
        assert peer.diagnosed()[0].startswith("1 message refused in the last second, the last on low_cmd: ")
        assert peer.diagnosed()[1]["braking"] == "True"
    peer.answer = answer
    peer.spin_until(lambda: peer.diagnosed()[1]["braking"] == "False")


def test_in_realtime_stamps_are_system_time(start: Start, peer: Any) -> None:
    before = time.time()
    start(mode="realtime", state_rate=500)
    states = peer.heard["low_state"]
    peer.spin_until(lambda: len(states) > 100)
    stamps = np.array([seconds(state.stamp) for state in states])
    assert before < stamps[0]
    assert stamps[-1] < time.time()
    assert np.median(np.diff(stamps)) == pytest.approx(0.002, abs=1e-5)
    assert not peer.heard["/clock"]


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_ctrl_c_ends_it_with_status_0_even_when_it_comes_twice(start: Start, peer: Any, mode: str) -> None:
    simulation = start(mode=mode)
    peer.spin_until(lambda: peer.heard["low_state"])
    if mode == "realtime":
        assert peer.call("pause", data=True).success
    simulation.interrupt()
    time.sleep(0.05)
    simulation.interrupt()
    status, text = simulation.end()
    assert status == 0
    # After a slow start it may report missing answers.
    assert all(line.startswith(("[INFO]", "[WARN]")) for line in text.splitlines()), text


DIVERGING = """
import quadvel_dds
quadvel_dds.install()
from quadvel_nodes.node import run
from quadvel_sim.sim_node import SimNode
from quadvel_sim.simulator import Simulator
class Diverging(Simulator):
    def push(self, *args):
        self.data.qvel[:] = 1e300
run(lambda: SimNode(Diverging))
"""


def test_a_diverged_simulation_ends_the_node_with_one_sentence(
    start: Start, peer: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log where it stands
    simulation = start(program=DIVERGING, mode="fast")
    peer.spin_until(lambda: peer.heard["low_state"])
    assert peer.call("push", duration=1.0).success
    status, text = simulation.end()
    assert status == 1
    assert "the robot's state is not finite" in text
    assert "Traceback" not in text


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"mode": "slow"}, "mode: found 'slow', expected one of realtime, lockstep, fast"),
        (
            {"friktion": 0.5},
            "unknown parameter friktion, expected one of realtime_priority, cpus, robot, keyframe,",
        ),
        ({"keyframe": "sit"}, "keyframe: found 'sit', expected one of stand, lie"),
    ],
)
def test_a_bad_parameter_ends_the_start_with_one_sentence(
    start: Start, parameters: dict, sentence: str
) -> None:
    status, text = start(**parameters).end()
    assert status == 2
    assert sentence in text
    assert len(text.strip().splitlines()) == 1


def test_without_an_actuator_file_the_model_is_named_a_plain_pd_law(
    start: Start, peer: Any, tmp_path: Path
) -> None:
    for file in ALIENGO.folder.iterdir():
        if file.name != "actuator.yaml":
            shutil.copy(file, tmp_path)
    start(robot=str(tmp_path))
    peer.spin_until(lambda: "plain PD law" in peer.diagnosed()[1].get("actuator", ""))
