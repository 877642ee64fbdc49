"""The controller's modes: what follows what, what is refused, and what ends in latched damping."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest

from quadvel_description.robot import COMMAND_UPPER, LIE_Q, NOMINAL_Q, TORQUE_LIMIT, UPPER
from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand, RobotState
from quadvel_policy.observation import PolicyMetadata
from quadvel_policy.supervisor import MODES, Supervisor, SupervisorConfig

PERIOD = 0.005
STILL = (0.0, 0.0, 0.0, 1.0)
FORWARD = (0.5, 0.0, 0.0, 0.0)


class Rig:
    """A robot whose joints follow their targets at once, driven at 200 Hz."""

    def __init__(self, policy: Any, **config: Any) -> None:
        self.policy = policy
        self.supervisor = Supervisor(policy, SupervisorConfig(**config))
        zeros = np.zeros(12)
        upright, down = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 9.81])
        self.state = RobotState(
            100.0, 0, LIE_Q.copy(), zeros, zeros, upright, np.zeros(3), down, np.full(4, 60.0)
        )
        self.velocity: Any = np.zeros(3)
        self.asked = JointCommand.damping()

    @property
    def mode(self) -> str:
        return self.supervisor.mode

    def tick(
        self, command: Any = STILL, age: float = 0.0, step: float = PERIOD, **changes: Any
    ) -> JointCommand:
        """One tick with the state changed for it alone."""
        time, tick = self.state.time + step, self.state.tick + round(1e3 * step)
        self.state = attrs.evolve(self.state, time=time, tick=tick)
        seen = attrs.evolve(self.state, **changes)
        self.asked = self.supervisor.tick(time + age, seen, self.velocity, command)
        if self.asked.kp.any():
            self.state.q = self.asked.q.copy()
        return self.asked

    def run(self, seconds: float, command: Any = STILL) -> None:
        for _ in range(round(seconds / PERIOD)):
            self.tick(command)

    def stand(self) -> Rig:
        self.tick()
        assert self.supervisor.request("stand_up") == (True, "mode is stand_up")
        self.run(2.5)
        assert self.mode == "stance", self.supervisor.reason
        return self

    def walk(self) -> Rig:
        self.stand()
        self.run(0.3, FORWARD)
        assert self.mode == "walk", self.supervisor.reason
        return self


@pytest.fixture
def rig(policy: Any) -> Rig:
    return Rig(policy)


def assert_damping(command: JointCommand) -> None:
    assert command.mode == MODE_DAMPING
    np.testing.assert_array_equal(command.kp, np.zeros(12))
    np.testing.assert_array_equal(command.tau, np.zeros(12))
    assert (command.kd > 0).all()


def test_the_modes_have_the_numbers_of_the_message() -> None:
    message = Path(__file__).parents[2] / "src/quadvel_msgs/msg/ControllerState.msg"
    constants = re.findall(r"uint8 ([A-Z_]+)=(\d)", message.read_text())
    assert [(name.lower(), int(number)) for name, number in constants] == [
        (name, i) for i, name in enumerate(MODES)
    ]


def test_it_starts_passive_and_brakes(rig: Rig) -> None:
    assert_damping(rig.tick(FORWARD))
    assert rig.mode == "passive"
    assert rig.asked.tick == rig.state.tick


def test_standing_up_goes_through_lying_to_the_nominal_posture(rig: Rig) -> None:
    rig.state.q = np.full(12, 0.1) + LIE_Q
    rig.tick()
    rig.supervisor.request("stand_up")
    rig.tick()
    np.testing.assert_allclose(rig.asked.q, np.minimum(LIE_Q + 0.1, COMMAND_UPPER), atol=1e-6)
    rig.run(0.8)
    np.testing.assert_allclose(rig.asked.q, LIE_Q, atol=1e-4)
    rig.run(1.205)
    assert rig.mode == "stance"
    rig.run(0.3)
    np.testing.assert_allclose(rig.asked.q, NOMINAL_Q, atol=1e-9)
    np.testing.assert_array_equal(rig.asked.kp, np.full(12, 100.0))
    np.testing.assert_array_equal(rig.asked.kd, np.full(12, 3.0))


def test_it_stands_up_by_itself_once_if_told_so(policy: Any) -> None:
    rig = Rig(policy, auto_stand=True)
    rig.tick(quaternion=np.array([0.0, 1.0, 0.0, 0.0]))
    assert rig.mode == "passive"  # not while it lies on its back
    rig.run(2.5)
    assert rig.mode == "stance"
    rig.supervisor.request("passive")
    rig.run(0.1)
    assert rig.mode == "passive"


def test_an_order_ends_standing_up_by_itself(policy: Any) -> None:
    rig = Rig(policy, auto_stand=True)
    rig.tick(quaternion=np.array([0.0, 1.0, 0.0, 0.0]))
    rig.supervisor.request("passive")
    rig.run(0.1)
    assert rig.mode == "passive"


def test_a_leg_that_does_not_follow_ends_standing_up(rig: Rig) -> None:
    rig.tick()
    rig.supervisor.request("stand_up")
    for _ in range(450):
        rig.tick(q=LIE_Q)
    assert rig.mode == "fault"
    assert re.search(
        r"standing up failed: .* is [+-]1\.\d+ rad off the nominal posture", rig.supervisor.reason
    )


def test_a_velocity_starts_walking_from_stance_at_once(rig: Rig) -> None:
    rig.stand()
    rig.tick((0.0, 0.0, 0.0, 0.0))
    assert rig.mode == "stance"
    rig.tick(FORWARD)
    assert rig.mode == "walk"
    assert not math.isnan(rig.supervisor.inference_seconds)


def test_walking_waits_until_the_posture_is_reached(rig: Rig) -> None:
    rig.state.q = NOMINAL_Q + 0.2
    rig.tick()
    assert rig.supervisor.request("stance")[0]
    rig.tick(STILL)
    rig.run(0.285, FORWARD)
    assert rig.mode == "stance"
    rig.run(0.05, FORWARD)
    assert rig.mode == "walk"


def test_walking_feeds_the_policy_and_uses_its_gains_and_targets(rig: Rig) -> None:
    rig.walk()
    rig.policy.action = np.linspace(-1, 1, 12, dtype=np.float32)
    rig.velocity = np.array([0.4, 0.1, 0.0])
    rig.tick((9.0, -9.0, 0.3, 0.0))
    rig.tick((9.0, -9.0, 0.3, 0.0))
    seen = rig.policy.seen[-1]
    np.testing.assert_allclose(seen[:4], [1.5, -0.5, 0.3, 0.0], atol=1e-6)  # held to the policy's limits
    np.testing.assert_allclose(seen[30:33], rig.velocity, atol=1e-6)
    np.testing.assert_allclose(seen[36:], rig.policy.action)
    np.testing.assert_allclose(rig.asked.target, rig.policy.metadata.action.targets(rig.policy.action))
    assert rig.asked.mode == MODE_SERVO
    np.testing.assert_array_equal(rig.asked.kp, np.full(12, 30.0))
    np.testing.assert_array_equal(rig.asked.kd, np.full(12, 0.5))
    np.testing.assert_allclose(rig.supervisor.command, [1.5, -0.5, 0.3, 0.0])


def test_walking_starts_with_a_fresh_policy_and_without_a_jump_of_torque(rig: Rig) -> None:
    rig.stand()
    rig.policy.action = np.full(12, 1.0, np.float32)
    before = rig.asked
    resets = rig.policy.resets
    q = rig.state.q - 0.1
    last = before.kp * (before.target - q)
    for i in range(40):
        command = rig.tick(FORWARD, q=q)
        torque = command.kp * (command.target - q)
        assert np.abs(torque - last).max() < 0.6, f"tick {i}"  # 13 N m in 30 ticks
        last = torque
    assert rig.policy.resets == resets + 1
    np.testing.assert_array_equal(rig.policy.seen[0][36:], np.zeros(12))
    np.testing.assert_allclose(last, 30.0 * (rig.policy.metadata.action.targets(rig.policy.action) - q))


def test_a_stance_command_keeps_the_policy_in_charge(rig: Rig) -> None:
    rig.walk()
    rig.run(0.1, (0.5, 0.2, 0.1, 1.0))
    assert rig.mode == "walk"
    np.testing.assert_array_equal(rig.policy.seen[-1][:4], STILL)


def test_a_command_that_is_not_finite_means_standing_still(rig: Rig) -> None:
    rig.walk()
    rig.tick((math.nan, 0.0, 0.0, 0.0))
    assert rig.mode == "walk"
    np.testing.assert_array_equal(rig.supervisor.command, STILL)


def test_on_a_robot_the_operator_allows_walking_first(policy: Any) -> None:
    rig = Rig(policy, require_operator=True)
    rig.stand()
    rig.run(0.1, FORWARD)
    assert rig.mode == "stance"
    assert "enable_walking" in rig.supervisor.walk_refusal
    taken, sentence = rig.supervisor.request("walk")
    assert not taken
    assert "enable_walking" in sentence
    rig.supervisor.enable_walking(True)
    rig.tick(FORWARD)
    assert rig.mode == "stance"  # that was ordered before it was allowed
    rig.tick(STILL)
    rig.tick(FORWARD)
    assert rig.mode == "walk"
    rig.supervisor.enable_walking(False)
    rig.tick(FORWARD)
    assert rig.mode == "walk"
    np.testing.assert_array_equal(rig.supervisor.command, STILL)


def test_the_permission_to_walk_ends_with_passive_and_with_a_fault(policy: Any) -> None:
    rig = Rig(policy, require_operator=True).stand()
    rig.supervisor.enable_walking(True)
    rig.supervisor.fail("a test")
    assert "in fault" in rig.supervisor.walk_refusal
    rig.supervisor.enable_walking(True)
    rig.supervisor.request("passive")
    rig.stand()
    assert "enable_walking" in rig.supervisor.walk_refusal


@pytest.mark.parametrize("standing_still", [STILL, (0.0, 0.0, 0.0, 0.0)])
def test_a_velocity_counts_only_after_a_zero_one_was_commanded_to_the_standing_robot(
    rig: Rig, standing_still: tuple[float, ...]
) -> None:
    rig.tick(STILL)  # before it stands nothing counts
    rig.supervisor.request("stand_up")
    rig.run(2.5, FORWARD)
    assert rig.mode == "stance"
    assert rig.supervisor.walk_refusal == "a zero velocity has to be commanded first"
    rig.run(0.1, None)  # silence is no order
    rig.run(0.5, FORWARD)
    assert rig.mode == "stance"
    rig.tick(standing_still)
    assert rig.supervisor.walk_refusal == ""
    rig.tick(FORWARD)
    assert rig.mode == "walk"


def test_after_a_fault_a_velocity_that_is_still_commanded_does_not_count(rig: Rig) -> None:
    rig.walk()
    rig.supervisor.fail("a test")
    rig.tick(FORWARD)
    rig.supervisor.request("passive")
    rig.supervisor.request("stand_up")
    rig.run(3.0, FORWARD)
    assert rig.mode == "stance"


def test_walking_that_was_asked_for_stands_until_a_zero_velocity_was_commanded(rig: Rig) -> None:
    rig.tick(None)
    rig.supervisor.request("stand_up")
    rig.run(2.5, None)
    assert rig.supervisor.request("walk")[0]
    rig.run(0.3, FORWARD)
    np.testing.assert_array_equal(rig.supervisor.command, STILL)
    rig.tick(STILL)
    rig.tick(FORWARD)
    np.testing.assert_allclose(rig.supervisor.command, FORWARD)


def test_lying_down_ends_passive(rig: Rig) -> None:
    rig.walk()
    rig.tick(STILL)
    assert rig.supervisor.request("lie_down")[0]
    rig.run(0.95)
    assert rig.mode == "lie_down"
    np.testing.assert_allclose(rig.asked.q, LIE_Q, atol=5e-3)
    rig.run(0.1)
    assert rig.mode == "passive"
    assert rig.supervisor.reason == "lies"
    assert_damping(rig.asked)


def test_walking_ends_in_a_posture_only_when_the_robot_stands(rig: Rig) -> None:
    rig.walk()
    taken, sentence = rig.supervisor.request("lie_down")
    assert not taken
    assert "command stance first" in sentence
    rig.velocity = np.array([0.6, 0.0, 0.0])
    rig.tick(STILL)
    taken, sentence = rig.supervisor.request("stance")
    assert not taken
    assert "0.60 m/s" in sentence
    rig.velocity = np.zeros(3)
    rig.tick(STILL)
    assert rig.supervisor.request("stance")[0]
    rig.run(0.4)
    assert rig.mode == "stance"
    np.testing.assert_allclose(rig.asked.q, NOMINAL_Q)


def test_a_standing_robot_may_go_to_stance_at_once_and_a_lying_one_may_not(rig: Rig) -> None:
    rig.tick()
    taken, sentence = rig.supervisor.request("stance")
    assert not taken
    assert "off the nominal posture" in sentence
    rig.state.q = NOMINAL_Q + 0.05
    rig.tick()
    assert rig.supervisor.request("stance")[0]


@pytest.mark.parametrize(
    ("mode", "sentence"), [("walk", "can't follow passive"), ("lie_down", "can't follow")]
)
def test_modes_out_of_order_are_refused(rig: Rig, mode: str, sentence: str) -> None:
    rig.tick()
    taken, message = rig.supervisor.request(mode)
    assert not taken
    assert sentence in message
    assert rig.mode == "passive"


@pytest.mark.parametrize("mode", ["fault", "fly", ""])
def test_unknown_modes_are_refused_by_name(rig: Rig, mode: str) -> None:
    taken, message = rig.supervisor.request(mode)
    assert not taken
    assert message == f"mode is '{mode}', expected one of passive, stand_up, stance, walk, lie_down"


def test_nothing_but_passive_is_taken_before_the_robot_reported(rig: Rig) -> None:
    assert rig.supervisor.request("stand_up") == (False, "the robot has not reported yet")
    assert rig.supervisor.request("passive")[0]


def test_a_robot_on_its_side_is_not_stood_up(rig: Rig) -> None:
    rig.tick(quaternion=np.array([math.cos(0.7), math.sin(0.7), 0.0, 0.0]))
    taken, message = rig.supervisor.request("stand_up")
    assert not taken
    assert message == "the trunk is tilted by 1.40 rad, limit 1.05"


def test_a_stale_state_refuses_standing_up(rig: Rig) -> None:
    rig.tick(age=0.2)
    taken, message = rig.supervisor.request("stand_up")
    assert not taken
    assert message == "the state is 200 ms old, limit 50 ms"


NOT_A_NUMBER = np.full(12, np.nan)
OUTSIDE = np.where(np.arange(12) == 5, UPPER + 0.5, NOMINAL_Q)
FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "stale state": ({"age": 0.06}, "the state is 60 ms old, limit 50 ms"),
    "gap": ({"step": 0.08}, "no state came for 80 ms, limit 50 ms"),
    "back in time": ({"step": -0.01}, "the state's time went back by 10 ms"),
    "q not finite": ({"q": NOT_A_NUMBER}, "the state's q is not finite"),
    "dq not finite": ({"dq": NOT_A_NUMBER}, "the state's dq is not finite"),
    "gyro not finite": (
        {"angular_velocity": np.full(3, np.inf)},
        "the state's angular_velocity is not finite",
    ),
    "no quaternion": ({"quaternion": np.zeros(4)}, "the state's quaternion has length 0.00, expected 1"),
    "tilt": (
        {"quaternion": np.array([math.cos(0.6), 0.0, math.sin(0.6), 0.0])},
        "the trunk is tilted by 1.20 rad, limit 1.05",
    ),
    "joint outside": ({"q": OUTSIDE}, "FL_calf_joint is at -0.15 rad, its range is -2.78 to -0.65"),
    "joint too fast": ({"dq": np.full(12, 50.0)}, "FR_hip_joint moves at 50 rad/s, limit 40"),
}


@pytest.mark.parametrize("mode", ["stand_up", "stance", "walk", "lie_down"])
@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_unsafe_latches_damping_with_its_reason(rig: Rig, mode: str, fault: str) -> None:
    if mode == "walk":
        rig.walk()
    else:
        rig.stand()
        if mode != "stance":
            rig.supervisor.request("passive" if mode == "stand_up" else mode)
            rig.supervisor.request(mode)
    rig.tick()
    assert rig.mode == mode
    changes, reason = FAULTS[fault]
    assert_damping(rig.tick(**changes))
    assert (rig.mode, rig.supervisor.reason) == ("fault", reason)
    rig.run(0.1, FORWARD)
    assert (rig.mode, rig.supervisor.reason) == ("fault", reason)
    assert_damping(rig.asked)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_passive_robot_may_be_handled_in_any_way(rig: Rig, fault: str) -> None:
    rig.tick()
    assert_damping(rig.tick(**FAULTS[fault][0]))
    assert rig.mode == "passive"


@pytest.mark.parametrize(
    ("velocity", "reason"),
    [
        (None, "there is no fresh velocity estimate"),
        (np.array([np.nan, 0.0, 0.0]), "the velocity estimate is not finite"),
    ],
)
def test_walking_without_a_velocity_is_a_fault(rig: Rig, velocity: Any, reason: str) -> None:
    rig.walk()
    rig.velocity = velocity
    assert_damping(rig.tick(FORWARD))
    assert (rig.mode, rig.supervisor.reason) == ("fault", reason)


def test_walking_does_not_start_without_a_velocity(rig: Rig) -> None:
    rig.velocity = None
    rig.stand()
    rig.tick(FORWARD)
    assert rig.mode == "stance"
    assert rig.supervisor.request("walk") == (False, "there is no fresh velocity estimate")


def test_an_action_that_is_not_finite_is_a_fault(rig: Rig) -> None:
    rig.walk()
    rig.policy.action = np.full(12, np.nan, np.float32)
    assert_damping(rig.tick(FORWARD))
    assert rig.mode == "fault"
    assert "not finite" in rig.supervisor.reason


def test_a_standing_robot_that_is_put_elsewhere_at_once_is_a_fault(rig: Rig) -> None:
    """As a simulator's reset does: targets of the stance would throw it over."""
    rig.stand()
    rig.state.q = LIE_Q.copy()
    answer = rig.tick()
    assert rig.mode == "fault"
    assert re.match(r"FR_calf_joint moved by -\d\.\d\d rad in 5 ms, limit 0\.40", rig.supervisor.reason)
    assert answer.mode == MODE_DAMPING


def test_while_somebody_finds_an_obstacle_nothing_moves(policy: Any) -> None:
    rig = Rig(policy, auto_stand=True)
    rig.supervisor.obstacle = "low_state has 2 publishers"
    rig.run(0.1)
    assert rig.mode == "passive"
    assert rig.supervisor.request("stand_up") == (False, "low_state has 2 publishers")
    rig.supervisor.obstacle = None
    rig.run(2.5)
    assert rig.mode == "stance"
    rig.supervisor.obstacle = "low_state has 2 publishers"
    rig.tick()
    assert (rig.mode, rig.supervisor.reason) == ("fault", "low_state has 2 publishers")


def test_a_fault_from_outside_is_latched_and_the_first_reason_stays(rig: Rig) -> None:
    rig.walk()
    rig.supervisor.fail("20 deadlines were missed in a row")
    rig.supervisor.fail("another")
    assert_damping(rig.tick(FORWARD))
    assert rig.supervisor.reason == "20 deadlines were missed in a row"


def test_a_limp_robot_is_not_brought_into_fault(rig: Rig) -> None:
    rig.tick()
    rig.supervisor.fail("20 deadlines were missed in a row")
    assert rig.mode == "passive"


def test_passive_clears_a_fault_and_nothing_else_does(rig: Rig) -> None:
    rig.walk()
    rig.tick(age=1.0)
    taken, message = rig.supervisor.request("stand_up")
    assert not taken
    assert message == "is in fault (the state is 1000 ms old, limit 50 ms), request passive first"
    assert rig.supervisor.request("passive")[0]
    rig.stand()


def test_the_policy_forgets_on_entry_on_a_fault_and_after_a_gap(rig: Rig) -> None:
    rig.walk()
    resets = rig.policy.resets
    rig.tick(FORWARD)
    assert rig.policy.resets == resets
    rig.tick(FORWARD, step=0.03)
    assert rig.policy.resets == resets + 1
    np.testing.assert_array_equal(rig.policy.seen[0][36:], np.zeros(12))
    rig.tick(FORWARD, age=1.0)
    assert rig.policy.resets == resets + 2
    rig.supervisor.request("passive")
    before = rig.policy.resets
    rig.walk()
    assert rig.policy.resets > before


def test_targets_stay_in_the_range_of_commands(make_policy: Callable[..., Any]) -> None:
    rig = Rig(make_policy(nominal_q=tuple(UPPER + 0.1)), max_posture_error=9.0, joint_margin=9.0)
    rig.stand()
    rig.run(0.4)
    np.testing.assert_array_equal(rig.asked.q, COMMAND_UPPER)


def test_what_a_policy_asks_for_beyond_the_range_goes_as_torque(rig: Rig) -> None:
    rig.walk()
    rig.run(0.2)
    rig.policy.action = np.full(12, 4.0, np.float32)
    wanted = rig.policy.metadata.action.targets(rig.policy.action)
    rig.tick(FORWARD)
    np.testing.assert_array_equal(rig.asked.q, np.minimum(wanted, COMMAND_UPPER))
    np.testing.assert_allclose(rig.asked.target, wanted)
    rig.policy.action = np.full(12, 1e6, np.float32)
    rig.tick(FORWARD)
    np.testing.assert_array_equal(rig.asked.q, COMMAND_UPPER)
    np.testing.assert_array_less(rig.asked.tau, TORQUE_LIMIT + 1e-9)


@pytest.mark.parametrize("field", ["stand_kp", "rise_time", "max_state_age"])
def test_settings_that_make_no_sense_are_refused_by_name(field: str) -> None:
    with pytest.raises(ValueError, match=field):
        SupervisorConfig(**{field: 0.0})


def test_limits_of_the_command_come_from_the_policy(metadata: PolicyMetadata, rig: Rig) -> None:
    rig.walk()
    rig.tick((-9.0, 9.0, -9.0, 0.0))
    low, high = metadata.limits.low, metadata.limits.high
    np.testing.assert_array_equal(rig.supervisor.command, [low[0], high[1], low[2], 0.0])


def test_commands_are_held_together_where_the_policy_says_how(make_policy: Callable[..., Any]) -> None:
    rig = Rig(make_policy(curve_limit=0.6))  # -1 to 1.5, 0.5 m/s, 1 rad/s
    rig.walk()
    for asked, taken in (
        ((0.0, 0.0, 9.0), (0.0, 0.0, 1.0)),
        ((1.5, 0.0, 1.0), (1.5, 0.0, 0.0)),
        ((0.75, 0.0, -1.0), (0.75, 0.0, -0.6 * 0.75 / 0.75)),
        ((0.75, 0.25, 1.0), (0.75, 0.25, 0.6 * 0.5 / 1.0)),
        ((0.75, -0.25, 0.2), (0.75, -0.25, 0.2)),
        ((9.0, 9.0, 1.0), (1.5 / np.sqrt(2), 0.5 / np.sqrt(2), 0.0)),
        ((-1.0, 0.5, 0.0), (-1.0 / np.sqrt(2), 0.5 / np.sqrt(2), 0.0)),
    ):
        rig.tick((*asked, 0.0))
        np.testing.assert_allclose(rig.supervisor.command, [*taken, 0.0], atol=1e-12, err_msg=str(asked))
