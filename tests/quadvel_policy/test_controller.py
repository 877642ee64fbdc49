"""The node `controller` over DDS: it answers states, and refuses invalid messages with a reason."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistWithCovarianceStamped
from rclpy.qos import qos_profile_sensor_data
from std_srvs.srv import SetBool

from quadvel_description.network_file import NetworkFileError
from quadvel_description.state import MODE_DAMPING, MODE_SERVO, RobotState
from quadvel_msgs.msg import ControllerState, LowCmd, LowState, MotorStatus, VelocityCommand, Waiting
from quadvel_msgs.srv import SetMode
from quadvel_nodes.flat_messages import encode_low_state
from quadvel_nodes.messages import write_low_state
from quadvel_nodes.node import StartError
from quadvel_nodes.scheduling import Scheduling
from quadvel_policy.control_loop import _value_if_fresh
from quadvel_policy.controller import Controller
from tests.helpers.robots import ALIENGO

PERIOD = 0.005


class Robot:
    """A standing robot in lockstep with the controller: each state waits for its answer.

    velocity: estimate for each state, None for no message.
    """

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        self.velocity: float | None = None
        zeros, upright = np.zeros(12), np.array([1.0, 0.0, 0.0, 0.0])
        self.state = RobotState(
            0.0, 0, ALIENGO.nominal_q.copy(), zeros, zeros, upright, zeros[:3], zeros[:3], zeros[:4]
        )
        self.answers = graph.listen(LowCmd, "low_cmd")
        self.reports = graph.listen(ControllerState, "controller/state")
        self._states = graph.speak(LowState, "low_state")
        self._velocity = graph.speak(TwistWithCovarianceStamped, "velocity_estimate")
        self._command = graph.speak(VelocityCommand, "command")

    def message(self, ahead: float = 0.0, **changes: Any) -> Any:
        message = LowState(stamp=self.graph.stamp(ahead))
        write_low_state(attrs.evolve(self.state, **changes), message)
        return message

    def send(self, message: Any) -> None:
        self._states.publish(message)

    def step(self, n: int = 1, **changes: Any) -> Any:
        """Let `n` periods pass, each with a state and its answer; returns the last answer."""
        for _ in range(n):
            self.graph.pass_time(PERIOD)
            self.state.tick += 5
            self.send(self.message(**changes))
            if self.velocity is not None:
                self.estimate(self.velocity)
            while not self.graph.holds(self.answered, 0.3):
                self.send(self.message(**changes))  # as a simulator does
        return self.answers[-1]

    def answered(self) -> bool:
        """Whether the last answer is that to the present state."""
        return bool(self.answers) and self.answers[-1].tick == self.state.tick

    def estimate(self, x: float = 0.0, ahead: float = 0.0) -> None:
        message = TwistWithCovarianceStamped()
        message.header.stamp = self.graph.stamp(ahead)
        message.twist.twist.linear.x = x
        self._velocity.publish(message)

    def order(self, vx: float, stance: bool = False, ahead: float = 0.0) -> None:
        message = VelocityCommand(stamp=self.graph.stamp(ahead), stance=stance, source="test")
        message.twist.linear.x = vx
        self._command.publish(message)

    def stand(self) -> Any:
        self.step(2)
        assert self.graph.call(SetMode, "controller/set_mode", mode="stance").success
        return self.step(2)

    def report(self, mode: str) -> Any:
        """Wait for a controller/state in `mode`."""
        self.graph.wait(lambda: self.reports and self.reports[-1].mode_name == mode)
        return self.reports[-1]


@pytest.fixture
def robot(graph: Callable[..., Any], write_policy: Callable[..., Path]) -> Robot:
    return Robot(graph(Controller, "-p", f"policy:={write_policy()}"))


def test_each_state_is_answered_by_its_tick(robot: Robot) -> None:
    assert robot.step().mode == MODE_DAMPING
    answer = robot.stand()
    assert answer.mode == MODE_SERVO
    np.testing.assert_allclose(answer.kp, np.full(12, 150.0))
    np.testing.assert_allclose(answer.q, ALIENGO.nominal_q, atol=1e-6)
    assert list(dict.fromkeys(answer.tick for answer in robot.answers)) == [5, 10, 15, 20, 25]


def test_a_simulator_that_sends_a_state_again_gets_its_answer_again(robot: Robot) -> None:
    robot.step(3)
    robot.send(robot.message())
    robot.graph.wait(lambda: len(robot.answers) == 4)
    assert robot.answers[-1].tick == robot.answers[-2].tick


def test_faster_states_do_not_make_the_controller_faster(robot: Robot) -> None:
    robot.state.q = ALIENGO.nominal_q + 0.1
    robot.stand()  # on the way to the nominal posture each tick has another target
    robot.answers.clear()
    for _ in range(50):
        robot.graph.pass_time(0.001)
        robot.state.tick += 1
        robot.send(robot.message())
        robot.graph.wait(lambda: robot.answers and robot.answers[-1].tick == robot.state.tick)
    assert len(robot.answers) == 50
    assert len({answer.q[0] for answer in robot.answers}) in (10, 11)
    assert robot.report("stance").overruns == 0


def test_a_command_starts_walking_once_the_operator_allows_it(
    graph: Callable[..., Any], write_policy: Callable[..., Path]
) -> None:
    robot = Robot(graph(Controller, "-p", f"policy:={write_policy()}", "-p", "require_operator:=true"))
    robot.stand()
    robot.step(65)
    robot.velocity = 0.0
    robot.order(0.5)
    robot.step(5)
    report = robot.report("stance")
    assert not report.walk_allowed
    assert "enable_walking" in report.walk_refusal
    refused = robot.graph.call(SetMode, "controller/set_mode", mode="walk")
    assert not refused.success
    assert "enable_walking" in refused.message
    assert robot.graph.call(SetBool, "controller/enable_walking", data=True).success
    robot.order(0.0)
    robot.step(5)
    robot.order(0.5)
    robot.step(5)
    robot.graph.node._report()  # once a second
    robot.step(5)
    report = robot.report("walk")
    assert report.mode == ControllerState.WALK
    assert report.walk_allowed
    assert not report.walk_refusal
    assert report.command.linear.x == pytest.approx(0.5)
    assert not report.stance
    assert report.inference_p50_us > 0


def walk(robot: Robot) -> None:
    robot.stand()
    robot.step(65)
    robot.velocity = 0.0
    robot.order(0.0)
    robot.step(4)
    robot.order(0.5)
    robot.step(5)
    robot.report("walk")


def test_a_robot_whose_commands_stop_stands_still(robot: Robot) -> None:
    walk(robot)
    robot.step(105)
    assert robot.report("walk").stance


def test_without_a_fresh_velocity_it_walks_on_the_kalman_filters_and_reports_it(robot: Robot) -> None:
    walk(robot)
    robot.velocity = None
    robot.step(16)
    report = robot.report("walk")
    assert (report.fault, list(report.findings)) == ("", ["there is no fresh velocity estimate"])
    assert robot.step().mode == MODE_SERVO
    robot.velocity = 0.0
    robot.graph.wait(lambda: robot.step() and not robot.reports[-1].findings)


def test_a_fault_is_reported_by_name_and_in_a_sentence(robot: Robot) -> None:
    walk(robot)
    lying_on_its_side = np.array([math.cos(0.7), math.sin(0.7), 0.0, 0.0])
    robot.state.quaternion = lying_on_its_side
    assert robot.step(5).mode == MODE_DAMPING
    report = robot.report("fault")
    assert (report.fault, report.reason) == ("tilted", "the trunk is tilted by 1.40 rad, limit 1.05")
    status = robot.graph.diagnosed("fault: the trunk is tilted by 1.40 rad, limit 1.05")
    assert status.level == DiagnosticStatus.ERROR
    assert status.name == "controller"


def test_a_hot_motor_makes_the_robot_stand(robot: Robot) -> None:
    walk(robot)
    motors = robot.graph.speak(MotorStatus, "motor_status")
    robot.graph.wait(lambda: motors.get_subscription_count())
    motors.publish(MotorStatus(temperature=np.full(12, 91.0, np.float32), dropped_out=[False] * 12))
    robot.graph.wait(lambda: robot.step() and robot.reports[-1].fault == "motor_hot")


def test_a_simulated_robot_waits_for_the_estimator_but_not_for_ever(robot: Robot) -> None:
    walk(robot)
    robot.velocity = None
    robot.step()  # the estimate of the tick before is there
    robot.graph.pass_time(PERIOD)
    robot.state.tick += 5
    robot.send(robot.message())
    assert not robot.graph.holds(robot.answered, 0.2)
    robot.estimate()
    robot.graph.wait(robot.answered)
    robot.step(2)  # the second is answered when it is sent again
    assert robot.report("walk").overruns == 0


def test_a_simulated_robot_waits_for_its_commands_but_not_for_ever(robot: Robot) -> None:
    walk(robot)
    robot.order(0.5)
    robot.step(50)
    robot.graph.pass_time(PERIOD)
    robot.state.tick += 5
    robot.send(robot.message())
    robot.estimate()
    assert not robot.graph.holds(robot.answered, 0.2)  # it is about to outrun the mux
    robot.order(0.5)
    robot.graph.wait(robot.answered)
    robot.answers.clear()
    robot.step(49)
    assert len(robot.answers) == 49
    robot.step(15)  # each of the first ones is answered when it is sent again
    assert not robot.report("walk").stance


def test_states_that_stop_are_a_fault(robot: Robot) -> None:
    robot.stand()
    answers = len(robot.answers)
    for _ in range(4):
        robot.graph.pass_time(0.02)
    report = robot.report("fault")
    assert report.mode == ControllerState.FAULT
    assert "ms old, limit 50 ms" in report.reason
    robot.graph.wait(lambda: len(robot.answers) > answers)
    assert robot.answers[-1].mode == MODE_DAMPING


def test_a_stall_of_the_whole_machine_is_no_event_of_the_walk(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk(robot)
    forgotten: list[bool] = []
    monkeypatch.setattr(robot.graph.node._supervisor._walk, "reset", lambda: forgotten.append(True))
    for _ in range(3):
        robot.graph.pass_time(0.06)
        robot.step(3)  # 5 ms by the robot's own clock
    assert robot.report("walk").overruns == 0
    assert not forgotten
    robot.graph.diagnosed("stalled_s: 0.180")
    robot.graph.diagnosed("pauses: 3")


def test_a_state_that_a_stall_made_old_is_refused_and_the_next_one_taken(robot: Robot) -> None:
    walk(robot)
    robot.state.tick += 5
    late = robot.message()
    robot.graph.pass_time(0.06)
    robot.send(late)
    robot.graph.diagnosed("refused low_state: 1, last: stamp is 0.060 s old")
    robot.step(5)
    robot.report("walk")


def test_a_robot_that_went_on_while_the_controller_could_not_run_is_a_fault(robot: Robot) -> None:
    walk(robot)
    robot.graph.pass_time(0.06)
    robot.state.tick += 60
    robot.step(5)
    assert robot.report("fault").reason.endswith("limit 50 ms")


def test_a_robot_that_stood_still_while_the_controller_listened_is_a_fault(robot: Robot) -> None:
    walk(robot)
    for _ in range(3):
        robot.graph.pass_time(0.016)
    robot.step(5)  # the first is 5 ms later by its own clock
    assert robot.report("fault").reason.endswith("limit 50 ms")


def test_states_that_do_not_come_after_a_stall_are_a_fault_a_period_later(robot: Robot) -> None:
    walk(robot)
    reports = len(robot.reports)
    robot.graph.pass_time(0.06)
    robot.graph.wait(lambda: len(robot.reports) > reports)
    assert robot.reports[-1].mode_name == "walk"
    for _ in range(2):
        robot.graph.pass_time(0.02)
    assert robot.report("fault").reason == "the state is 100 ms old, limit 50 ms"


def unfit_states(robot: Robot) -> dict[str, bytes]:
    def encoded(ahead: float = 0.0, **changes: Any) -> bytes:
        stamp = robot.graph.stamp(ahead)
        return encode_low_state((stamp.sec, stamp.nanosec), attrs.evolve(robot.state, tick=1, **changes))

    return {
        "dq holds nan": encoded(dq=np.full(12, np.nan)),
        "message has 212 bytes, expected 50 numbers": encoded()[:-4],
        "stamp is 1.000 s old": encoded(-1.0),
        "orientation_wxyz has norm 0": encoded(quaternion=np.zeros(4)),
    }


@pytest.mark.parametrize(
    "what",
    [
        "dq holds nan",
        "message has 212 bytes, expected 50 numbers",
        "stamp is 1.000 s old",
        "orientation_wxyz has norm 0",
    ],
)
def test_an_unfit_state_is_refused_counted_and_named_and_the_node_goes_on(robot: Robot, what: str) -> None:
    robot.stand()
    robot.graph.node._on_state(unfit_states(robot)[what])  # which the middleware would drop, some of them
    assert robot.step().mode == MODE_SERVO
    assert all(answer.tick != 1 for answer in robot.answers)
    status = robot.graph.diagnosed(f"refused low_state: 1, last: {what}")
    assert status.level == DiagnosticStatus.WARN
    assert "1 message refused" in status.message
    assert what in status.message
    robot.graph.pass_time(0.02)
    robot.graph.wait(lambda: robot.reports[-1].refused == 1)


UNFIT: dict[str, dict[str, Any]] = {
    "state_not_finite": {"q": np.full(12, np.nan)},
    "attitude_not_unit": {"quaternion": np.array([1.2, 0.0, 0.0, 0.0])},
}


@pytest.mark.parametrize("fault", UNFIT)
def test_states_that_are_refused_become_the_fault_that_is_wrong_with_them(robot: Robot, fault: str) -> None:
    robot.stand()
    for _ in range(8):
        robot.graph.pass_time(0.01)
        robot.state.tick += 10
        robot.send(robot.message(**UNFIT[fault]))
    report = robot.report("fault")
    assert report.fault == fault
    assert report.reason.startswith("low_state is refused: ")


def test_states_that_go_back_in_time_become_that_fault(robot: Robot) -> None:
    robot.stand()
    for k in range(8):
        robot.graph.pass_time(0.01)
        robot.send(robot.message(-0.01 * (k + 3)))  # all have the same stamp, older than the last valid one
    assert robot.report("fault").fault == "state_back_in_time"


def test_a_controller_that_did_not_run_is_the_cause_of_what_follows(robot: Robot) -> None:
    walk(robot)
    robot.graph.pass_time(2.0)
    robot.state.tick += 2000
    robot.step(2)
    assert robot.report("fault").fault == "controller_stopped"


def test_a_robot_whose_time_stands_still_is_not_silent(robot: Robot) -> None:
    walk(robot)
    waiting = robot.graph.speak(Waiting, "waiting")
    robot.graph.wait(lambda: waiting.get_subscription_count())
    for _ in range(20):
        robot.graph.pass_time(0.02)
        waiting.publish(Waiting(stamp=robot.graph.stamp(0.0), tick=robot.state.tick))
        robot.graph.holds(lambda: False, 0.02)
    robot.step(2)
    assert robot.report("walk").mode_name == "walk"


def test_a_robot_that_waits_at_an_unknown_tick_is_silent(robot: Robot) -> None:
    """Its states are withheld."""
    walk(robot)
    waiting = robot.graph.speak(Waiting, "waiting")
    robot.graph.wait(lambda: waiting.get_subscription_count())
    for _ in range(8):
        robot.graph.pass_time(0.02)
        waiting.publish(Waiting(stamp=robot.graph.stamp(0.0), tick=robot.state.tick + 10))
    assert robot.report("fault").fault == "state_stale"


def test_a_command_that_is_refused_is_named_once_the_last_fit_one_is_old(robot: Robot) -> None:
    walk(robot)
    for _ in range(105):
        robot.order(math.nan)
        robot.step()
    report = robot.report("walk")
    assert report.stance
    assert "command is refused: linear is [nan" in report.findings[0]


def test_the_trim_of_a_slow_robot_is_reported(robot: Robot) -> None:
    walk(robot)
    for _ in range(8):
        robot.order(0.5)
        robot.step(50)
    robot.graph.diagnosed("velocity_trim: 0.100, 0.000 m/s, 0.000 rad/s")


def test_unfit_velocities_and_commands_are_refused_and_the_last_fit_ones_stay(robot: Robot) -> None:
    walk(robot)
    robot.velocity = np.nan
    robot.order(np.inf)
    robot.step()
    robot.velocity = 0.0
    robot.step()
    robot.estimate(ahead=-1.0)
    robot.order(0.1, ahead=-1.0)
    robot.graph.diagnosed("refused velocity_estimate: 2")
    robot.step(3)
    assert robot.report("walk").command.linear.x == pytest.approx(0.5)
    robot.graph.diagnosed("refused velocity_estimate: 2, last: stamp is")
    robot.graph.diagnosed("refused command: 2, last: stamp is")


def test_set_mode_says_why_it_refuses(robot: Robot) -> None:
    response = robot.graph.call(SetMode, "controller/set_mode", mode="stand_up")
    assert (response.success, response.message) == (False, "the robot has not reported yet")
    response = robot.graph.call(SetMode, "controller/set_mode", mode="jump")
    assert response.message.startswith("mode is 'jump', expected one of")


def test_the_requester_of_a_mode_is_named_in_its_reason(robot: Robot) -> None:
    robot.stand()
    request = {"mode": "passive", "requester": "STOP on the page"}
    assert robot.graph.call(SetMode, "controller/set_mode", **request).success
    robot.graph.diagnosed("passive: requested by STOP on the page")


def test_a_second_controller_refuses_to_start_and_another_writer_is_warned_of(robot: Robot) -> None:
    robot.step(2)
    robot.stand()
    with pytest.raises(StartError, match="low_cmd is already published"):
        Controller()
    robot.graph.peer.create_publisher(LowCmd, "low_cmd", 1)  # as one that was discovered too late
    robot.step(5)
    robot.graph.diagnosed("low_cmd has 2 publishers, expected 1")
    assert robot.report("stance")  # a silent one stops nothing


def test_a_second_robot_on_the_same_topic_is_a_fault_and_refuses_to_be_stood_up(robot: Robot) -> None:
    robot.step(2)
    robot.stand()
    other = robot.graph.speak(LowState, "low_state")
    robot.graph.diagnosed("low_state has 2 publishers, expected 1")
    robot.step(5)
    assert robot.report("fault").reason.startswith("low_state has 2 publishers")
    assert robot.graph.call(SetMode, "controller/set_mode", mode="passive").success
    response = robot.graph.call(SetMode, "controller/set_mode", mode="stand_up")
    assert (response.success, response.message[:28]) == (False, "low_state has 2 publishers, ")
    robot.graph.peer.destroy_publisher(other)
    robot.graph.wait(lambda: robot.graph.call(SetMode, "controller/set_mode", mode="stance").success)


def test_in_real_time_a_best_effort_driver_is_received(
    write_policy: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Scheduling, "apply", lambda *_: None)  # the tests' process keeps its priority
    rclpy.init(args=["--ros-args", "-p", f"policy:={write_policy()}"])
    try:
        controller, driver = Controller(), rclpy.create_node("driver", use_global_arguments=False)
        states = driver.create_publisher(LowState, "low_state", qos_profile_sensor_data)
        until = time.monotonic() + 20.0
        while not states.get_subscription_count() and time.monotonic() < until:
            time.sleep(0.02)
        assert states.get_subscription_count() == 1
        for node in (controller, driver):
            node.destroy_node()
    finally:
        rclpy.shutdown()


@pytest.mark.parametrize(("age", "followed"), [(0.1, True), (-0.1, True), (0.6, False), (-60.0, False)])
def test_a_command_too_old_or_from_the_future_is_not_followed(age: float, followed: bool) -> None:
    assert (_value_if_fresh((100.0 - age, np.ones(4)), 100.0, 0.5) is not None) == followed


def start(*parameters: str) -> None:
    arguments = [argument for parameter in parameters for argument in ("-p", parameter)]
    rclpy.init(args=["--ros-args", *arguments])
    try:
        Controller().destroy_node()
    finally:
        rclpy.shutdown()


@pytest.mark.parametrize(
    ("parameter", "sentence"),
    [
        ("policy:=/nowhere/policy.onnx", r"/nowhere/policy\.onnx: no such file"),
        ("max_tilt:=-1.0", "max_tilt"),
        ("max_tilt:=steep", "max_tilt"),
        ("max_tild:=1.0", "unknown parameter max_tild, expected one of"),
    ],
)
def test_what_can_not_work_is_refused_at_the_start_in_one_sentence(parameter: str, sentence: str) -> None:
    with pytest.raises((StartError, NetworkFileError), match=sentence):
        start(parameter)


PROGRAM = "import quadvel_dds; quadvel_dds.install(); from quadvel_policy.controller import main; main()"


def process(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *arguments],
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_bad_start_ends_the_process_with_one_sentence() -> None:
    with process("--ros-args", "-p", "policy:=/nowhere/policy.onnx") as child:
        _, errors = child.communicate(timeout=60)
    assert child.returncode == 2
    assert errors.strip() == "/nowhere/policy.onnx: no such file, expected an ONNX network"


def test_ctrl_c_twice_ends_the_process_with_exit_code_0(write_policy: Callable[..., Path]) -> None:
    with process("--ros-args", "-p", f"policy:={write_policy()}") as child:
        rclpy.init(args=[])
        peer = rclpy.create_node("peer")
        while not peer.count_publishers("low_cmd"):
            rclpy.spin_once(peer, timeout_sec=0.05)
            assert child.poll() is None
        peer.destroy_node()
        rclpy.shutdown()
        child.send_signal(signal.SIGINT)
        child.send_signal(signal.SIGINT)
        _, errors = child.communicate(timeout=60)
    assert child.returncode == 0, errors
    assert "Traceback" not in errors
