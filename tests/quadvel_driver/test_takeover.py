"""When the joints of a robot with a controller of its own are taken, kept and let go: in simulated time."""

from __future__ import annotations

from collections import Counter, deque

import attrs
import numpy as np
import pytest

from quadvel_description.state import JointCommand
from quadvel_driver.board_state import Battery, BoardState
from quadvel_driver.link import SHUTDOWN_PACKETS, Link, LinkConfig, Transport
from quadvel_driver.takeover import Access
from quadvel_driver.unitree_dds import takeover, wire
from quadvel_driver.unitree_dds.motion_switcher import Answer, Api
from quadvel_driver.unitree_dds.takeover import DdsTakeover
from tests.helpers.robots import GO2

from .test_dds_wire import some_state

TURN_S = 0.01
SHORT_TURN_S = 0.002  # the link's own
LONG_TURN_S = 0.04


class Robot:
    """The robot's side: motion switcher, other writers, and what reaches the joints."""

    def __init__(self) -> None:
        self.mode = "mcf"
        self.answers_requests = self.releases = True
        self.codes: dict[int, int] = {}
        self.asked: list[int] = []
        self.samples = 0  # that others write
        self.writers = 0  # of others, also silent ones
        self.claimed = 0
        self._answers: list[Answer] = []

    def ask(self, api: Api) -> None:
        self.asked.append(api)
        code = self.codes.get(api, 0)
        if api == Api.RELEASE_MODE and self.releases and not code:
            self.mode = ""
        if self.answers_requests:
            said = self.mode if api == Api.CHECK_MODE and not code else None
            self._answers.append(Answer(api, code, said))

    def answers(self) -> list[Answer]:
        found, self._answers = self._answers, []
        return found

    def claim(self) -> None:
        self.claimed += 1

    def foreign_commands(self) -> int:
        found, self.samples = self.samples, 0
        return found

    def foreign_writers(self) -> int:
        return self.writers


class Joints(Transport):
    """The wire: what the link sent, with its time, and the states that it reads."""

    def __init__(self) -> None:
        self.board, self.counts = "robot", Counter()
        self.sent: list[JointCommand] = []
        self.states: deque[bytes] = deque()

    def send(self, packet: bytes) -> None:
        self.sent.append(wire.decode_command(packet))

    def receive(self) -> bytes | None:
        return self.states.popleft() if self.states else None

    def wait(self, timeout: float) -> None:
        raise AssertionError("time is simulated")

    def close(self) -> None:
        pass


class Driver:
    """A link with its takeover on a clock of its own."""

    def __init__(self, robot: Robot, charge: int = 80) -> None:
        self.now = 100.0
        self.robot, self.joints = robot, Joints()
        self.state = some_state()
        self.state.battery = Battery(charge, 29.0, -1.0)
        self.takeover = DdsTakeover(robot, robot, min_battery=20)
        config = LinkConfig(command_timeout=0.5)
        self.link = Link(
            GO2, wire, self.joints, config, self._on_state, takeover=self.takeover, clock=lambda: self.now
        )
        self._newest: BoardState | None = None

    def _on_state(self, state: BoardState) -> None:
        self._newest = state

    def run(self, seconds: float, turn: float = TURN_S) -> None:
        """Turns of the link; a controller answers each state with a stiff command."""
        for _ in range(round(seconds / turn)):
            self.now += turn
            self.state.robot.tick = round(1e3 * self.now)
            self.joints.states.append(wire.encode_state(self.state))
            self.link.serve()
            if self._newest is not None:
                stiff = {"kp": np.full(12, 60.0), "kd": np.full(12, 5.0)}
                self.link.submit(JointCommand(q=self.state.robot.q, tick=self._newest.robot.tick, **stiff))

    def problem(self) -> str:
        return self.link.report().takeover

    def forget(self) -> None:
        self.joints.sent.clear()


def brakes(command: JointCommand) -> bool:
    return not command.kp.any() and not command.tau.any() and (command.kd == 5.0).all()


@pytest.fixture
def robot() -> Robot:
    return Robot()


@pytest.fixture
def holding(robot: Robot) -> Driver:
    """A driver that holds the joints and follows commands."""
    driver = Driver(robot)
    driver.run(3.0)
    assert driver.takeover.access is Access.FULL
    assert (driver.problem(), robot.claimed) == ("", 1)
    assert driver.joints.sent[-1].kp[0] == 60.0
    driver.forget()
    return driver


def test_nothing_is_sent_before_the_robots_own_controller_has_let_go(robot: Robot) -> None:
    robot.releases = False
    driver = Driver(robot)
    driver.run(5.0, LONG_TURN_S)
    assert "the robot's own controller 'mcf' holds the legs" in driver.problem()
    driver.run(takeover.RELEASE_TIMEOUT_S, LONG_TURN_S)
    assert "has not let go for 1" in driver.problem()
    assert (driver.joints.sent, robot.claimed) == ([], 0)
    robot.releases = True
    driver.run(3.0)
    assert driver.joints.sent[-1].kp[0] == 60.0


def test_the_first_that_is_sent_is_damping_or_a_fresh_command(robot: Robot) -> None:
    driver = Driver(robot)
    while not driver.joints.sent:
        driver.run(TURN_S)
    assert robot.mode == ""
    assert robot.asked.count(Api.RELEASE_MODE) == 1


@pytest.mark.parametrize(
    ("changes", "charge", "sentence"),
    [
        ({}, 12, "the battery is at 12 %, expected at least 20 %: the joints are not taken over"),
        ({"answers_requests": False}, 80, "firmware before 1.0.24 has none and cannot release the legs"),
        ({"codes": {Api.CHECK_MODE: 3203}}, 80, "answers request 1001 with error 3203: this firmware"),
        ({"codes": {Api.RELEASE_MODE: 3203}}, 80, "answers request 1003 with error 3203: this firmware"),
        ({"writers": 1}, 80, r"may command the joints \(1 silent writers of rt/lowcmd\)"),
    ],
)
def test_each_reason_against_a_takeover_is_one_sentence_and_nothing_is_sent(
    robot: Robot, changes: dict[str, object], charge: int, sentence: str
) -> None:
    for name, value in changes.items():
        setattr(robot, name, value)
    driver = Driver(robot, charge)
    driver.run(6.0, LONG_TURN_S)
    with pytest.raises(AssertionError, match=sentence):
        raise AssertionError(driver.problem())
    assert (driver.joints.sent, robot.claimed) == ([], 0)


def test_an_old_answer_of_the_switcher_does_not_count(robot: Robot) -> None:
    robot.writers = 1
    driver = Driver(robot)
    driver.run(2.0)
    assert robot.mode == ""
    robot.answers_requests = False
    driver.run(takeover.ANSWER_TIMEOUT_S + 1.0, LONG_TURN_S)
    robot.writers = 0
    driver.run(3.0)
    assert "the motion switcher has not answered for 3 s" in driver.problem()
    assert robot.claimed == 0


def test_a_release_that_failed_once_does_not_count_after_another_has_released(robot: Robot) -> None:
    robot.codes = {Api.RELEASE_MODE: 7}
    driver = Driver(robot)
    driver.run(2.0)
    assert "error 7" in driver.problem()
    robot.mode = ""
    driver.run(3.0)
    assert robot.claimed == 1


def test_a_robot_that_falls_silent_is_not_taken_over(robot: Robot) -> None:
    robot.releases = False
    driver = Driver(robot)
    driver.run(3.0)
    robot.mode = ""
    for _ in range(300):
        driver.now += TURN_S
        driver.link.serve()
    assert driver.problem() == "no state of the robot"
    assert (driver.joints.sent, robot.claimed) == ([], 0)


def test_with_a_low_battery_the_robots_own_controller_keeps_the_legs(robot: Robot) -> None:
    Driver(robot, charge=5).run(3.0)
    assert (robot.mode, robot.asked) == ("mcf", [])


def test_another_program_that_commands_is_refused_until_it_has_been_quiet_for_a_while(robot: Robot) -> None:
    driver = Driver(robot)
    for _ in range(100):
        robot.samples = 10
        driver.run(0.02)
    assert "another program commands the joints" in driver.problem()
    driver.run(0.5 * takeover.QUIET_S)
    assert (driver.joints.sent, robot.claimed) == ([], 0)
    driver.run(takeover.QUIET_S)
    assert robot.claimed == 1


@pytest.mark.parametrize("change", [{"samples": 1}, {"writers": 1}])
def test_another_writer_stops_the_joints_within_20_ms_and_then_nothing_is_sent(
    robot: Robot, holding: Driver, change: dict[str, object]
) -> None:
    for name, value in change.items():
        setattr(robot, name, value)
    holding.run(SHORT_TURN_S, SHORT_TURN_S)
    holding.forget()
    holding.run(0.02, SHORT_TURN_S)
    assert holding.joints.sent
    assert all(map(brakes, holding.joints.sent))
    assert "another program" in holding.problem()
    assert not holding.link.report().commanded
    holding.run(takeover.BRAKE_S)
    holding.forget()
    holding.run(5.0, LONG_TURN_S)
    assert holding.joints.sent == []


def test_a_controller_of_the_robot_that_comes_back_stops_the_joints(robot: Robot, holding: Driver) -> None:
    robot.mode = "normal"
    holding.run(takeover.ASK_PERIOD_S + 0.02)
    assert brakes(holding.joints.sent[-1])
    assert "the robot's own controller 'normal' is back" in holding.problem()
    assert robot.mode == "normal"  # it is not released: the operator may have wanted it
    holding.run(1.0)
    holding.forget()
    holding.run(3.0, LONG_TURN_S)
    assert holding.joints.sent == []


def test_lost_joints_are_not_taken_again(robot: Robot, holding: Driver) -> None:
    robot.samples = 1
    holding.run(10.0, LONG_TURN_S)
    assert holding.takeover.access is Access.NONE
    assert "start the driver again" in holding.problem()
    assert robot.claimed == 1


def test_a_switcher_that_falls_silent_is_reported_and_does_not_drop_a_walking_robot(
    robot: Robot, holding: Driver
) -> None:
    robot.answers_requests = False
    holding.run(takeover.ANSWER_TIMEOUT_S + 1.0)
    assert "the motion switcher has not answered for 3 s" in holding.problem()
    assert holding.joints.sent[-1].kp[0] == 60.0


def test_motors_that_stay_off_are_those_of_a_robot_that_is_no_edu_model(holding: Driver) -> None:
    holding.state = attrs.evolve(holding.state, motor_mode=np.zeros(12, np.uint8))
    holding.run(takeover.OBEY_TIMEOUT_S + 0.1)
    assert "only the EDU model obeys it" in holding.problem()


def test_a_link_that_ends_by_an_error_leaves_the_joints_braking() -> None:
    joints = Joints()
    link = Link(GO2, wire, joints, LinkConfig(), print)
    with pytest.raises(AssertionError, match="time is simulated"):
        link.run()
    assert len(joints.sent) == SHUTDOWN_PACKETS
    assert all(map(brakes, joints.sent))


def test_nothing_beyond_the_robots_limits_is_sent(holding: Driver) -> None:
    wild = JointCommand(*(np.full(12, 1e6) for _ in range(3)), kp=np.full(12, 50.0), kd=np.ones(12))
    wild.tick = round(1e3 * holding.now)
    holding.link.submit(wild)
    sent = holding.joints.sent[-1]
    np.testing.assert_allclose(sent.q, GO2.command_upper, rtol=1e-6)
    np.testing.assert_allclose(sent.dq, GO2.velocity_limit)
    np.testing.assert_allclose(sent.tau, GO2.torque_limit, rtol=1e-6)
