"""The controller's modes: what follows what, what is refused, and how a fault is left."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadvel_description.state import MODE_SERVO
from quadvel_nodes.parameters import make_record, parameter_fields
from quadvel_policy.config import SupervisorConfig
from quadvel_policy.control_loop import ControlConfig
from quadvel_policy.guards import GUARDS
from quadvel_policy.guards.legs import EncoderInconsistent
from quadvel_policy.observation import PolicyMetadata
from quadvel_policy.supervisor import Supervisor
from quadvel_policy.transitions import MODES
from tests.helpers.robots import ALIENGO
from tests.quadvel_policy.rig import FORWARD, STILL, Rig, assert_damping

WITHOUT_ENCODERS = [guard for guard in GUARDS if guard is not EncoderInconsistent]


@pytest.fixture
def rig(policy: Any) -> Rig:
    return Rig(policy)


def test_the_modes_have_the_numbers_of_the_message() -> None:
    message = Path(__file__).parents[2] / "src/quadvel_msgs/msg/ControllerState.msg"
    constants = re.findall(r"uint8 ([A-Z_]+)=(\d)", message.read_text())
    assert [(name.lower(), int(number)) for name, number in constants] == [
        (name, i) for i, name in enumerate(MODES)
    ]


def test_it_starts_passive_and_brakes(rig: Rig) -> None:
    assert_damping(rig.tick(FORWARD))
    assert rig.mode == "passive"
    assert rig.answer.tick == rig.state.tick


def test_standing_up_goes_through_lying_to_the_nominal_posture(rig: Rig) -> None:
    rig.state.q = np.full(12, 0.1) + ALIENGO.lie_q
    rig.tick()
    rig.supervisor.request("stand_up")
    rig.tick()
    np.testing.assert_allclose(
        rig.answer.q, np.minimum(ALIENGO.lie_q + 0.1, ALIENGO.command_upper), atol=1e-6
    )
    rig.run(0.8)
    np.testing.assert_allclose(rig.answer.q, ALIENGO.lie_q, atol=1e-4)
    rig.run(1.205)
    assert rig.mode == "stance"
    rig.run(0.3)
    np.testing.assert_allclose(rig.answer.q, ALIENGO.nominal_q, atol=1e-9)
    np.testing.assert_array_equal(rig.answer.kp, np.full(12, 150.0))
    np.testing.assert_array_equal(rig.answer.kd, np.full(12, 4.0))


def test_it_stands_up_by_itself_once_with_auto_stand(policy: Any) -> None:
    rig = Rig(policy, auto_stand=True)
    rig.tick(quaternion=np.array([0.0, 1.0, 0.0, 0.0]))
    assert rig.mode == "passive"  # not while it lies on its back
    rig.run(2.5)
    assert rig.mode == "stance"
    rig.supervisor.request("passive")
    rig.run(0.1)
    assert rig.mode == "passive"


def test_a_request_cancels_standing_up_by_itself(policy: Any) -> None:
    rig = Rig(policy, auto_stand=True)
    rig.tick(quaternion=np.array([0.0, 1.0, 0.0, 0.0]))
    rig.supervisor.request("passive")
    rig.run(0.1)
    assert rig.mode == "passive"


def test_a_leg_that_does_not_follow_ends_standing_up(rig: Rig) -> None:
    rig.tick()
    rig.supervisor.request("stand_up")
    for _ in range(450):
        rig.tick(q=ALIENGO.lie_q)
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
    rig.state.q = ALIENGO.nominal_q + 0.2
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
    np.testing.assert_allclose(seen[:4], [1.5, -0.5, 0.3, 0.0], atol=1e-6)  # clamped to the policy's limits
    np.testing.assert_allclose(seen[30:33], rig.velocity, atol=1e-6)
    np.testing.assert_allclose(seen[36:], rig.policy.action)
    np.testing.assert_allclose(rig.answer.target, rig.policy.metadata.action.targets(rig.policy.action))
    assert rig.answer.mode == MODE_SERVO
    np.testing.assert_array_equal(rig.answer.kp, np.full(12, 30.0))
    np.testing.assert_array_equal(rig.answer.kd, np.full(12, 0.5))
    np.testing.assert_allclose(rig.supervisor.command, [1.5, -0.5, 0.3, 0.0])


def test_walking_starts_with_a_fresh_policy_and_without_a_jump_of_torque(rig: Rig) -> None:
    rig.stand()
    rig.policy.action = np.full(12, 1.0, np.float32)
    before = rig.answer
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


@pytest.mark.parametrize(("speed", "stance"), [(1.0, 0.0), (0.25, 0.0), (0.15, 1.0), (0.0, 1.0)])
def test_a_robot_commanded_to_stand_keeps_stepping_until_it_is_slow(
    rig: Rig, speed: float, stance: float
) -> None:
    rig.walk()
    rig.velocity = np.array([0.0, speed, 0.0])
    rig.tick(STILL)
    assert rig.mode == "walk"
    np.testing.assert_array_equal(rig.supervisor.command, [0.0, 0.0, 0.0, stance])


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
    assert "quadvel enable" in rig.supervisor.walk_refusal
    accepted, sentence = rig.supervisor.request("walk")
    assert not accepted
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


def test_a_simulated_robot_cannot_be_forbidden_to_walk_and_says_so(rig: Rig) -> None:
    rig.stand()
    accepted, sentence = rig.supervisor.enable_walking(False)
    assert not accepted
    assert "needs no permission" in sentence
    rig.tick(STILL)
    rig.tick(FORWARD)
    assert rig.mode == "walk"
    assert rig.supervisor.enable_walking(True)[0]


def test_a_robot_in_stance_that_is_asked_to_stand_up_stays_there(rig: Rig) -> None:
    rig.stand()
    assert rig.supervisor.request("stand_up")[0]
    rig.tick(STILL)
    assert rig.mode == "stance"


def test_the_permission_to_walk_ends_with_passive_and_with_a_fault(policy: Any) -> None:
    rig = Rig(policy, require_operator=True).stand()
    rig.supervisor.enable_walking(True)
    rig.supervisor.fail("a test", "test")
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
    rig.supervisor.fail("a test", "test")
    rig.tick(FORWARD)
    rig.supervisor.request("passive")
    rig.supervisor.request("stand_up")
    rig.run(3.0, FORWARD)
    assert rig.mode == "stance"


def test_requested_walking_stands_until_a_zero_velocity_was_commanded(rig: Rig) -> None:
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
    np.testing.assert_allclose(rig.answer.q, ALIENGO.lie_q, atol=5e-3)
    rig.run(0.1)
    assert rig.mode == "passive"
    assert rig.supervisor.reason == "lies"
    assert_damping(rig.answer)


def test_walking_ends_in_a_posture_only_when_the_robot_stands(rig: Rig) -> None:
    rig.walk()
    accepted, sentence = rig.supervisor.request("lie_down")
    assert not accepted
    assert "command stance first" in sentence
    rig.velocity = np.array([0.6, 0.0, 0.0])
    rig.tick(STILL)
    accepted, sentence = rig.supervisor.request("stance")
    assert not accepted
    assert "0.60 m/s" in sentence
    rig.velocity = np.zeros(3)
    rig.tick(STILL)
    assert rig.supervisor.request("stance")[0]
    rig.run(0.4)
    assert rig.mode == "stance"
    np.testing.assert_allclose(rig.answer.q, ALIENGO.nominal_q)


def test_a_standing_robot_may_go_to_stance_at_once_and_a_lying_one_may_not(rig: Rig) -> None:
    rig.tick()
    accepted, sentence = rig.supervisor.request("stance")
    assert not accepted
    assert "off the nominal posture" in sentence
    rig.state.q = ALIENGO.nominal_q + 0.05
    rig.tick()
    assert rig.supervisor.request("stance")[0]


@pytest.mark.parametrize(
    ("mode", "sentence"), [("walk", "can't follow passive"), ("lie_down", "can't follow")]
)
def test_modes_out_of_order_are_refused(rig: Rig, mode: str, sentence: str) -> None:
    rig.tick()
    accepted, message = rig.supervisor.request(mode)
    assert not accepted
    assert sentence in message
    assert rig.mode == "passive"


@pytest.mark.parametrize("mode", ["fault", "fly", ""])
def test_unknown_modes_are_refused_by_name(rig: Rig, mode: str) -> None:
    accepted, message = rig.supervisor.request(mode)
    assert not accepted
    assert message == f"mode is '{mode}', expected one of passive, stand_up, stance, walk, lie_down"


def test_only_passive_is_accepted_before_the_robot_reported(rig: Rig) -> None:
    assert rig.supervisor.request("stand_up") == (False, "the robot has not reported yet")
    assert rig.supervisor.request("passive")[0]


def test_a_robot_on_its_side_is_not_stood_up(rig: Rig) -> None:
    rig.tick(quaternion=np.array([math.cos(0.7), math.sin(0.7), 0.0, 0.0]))
    accepted, message = rig.supervisor.request("stand_up")
    assert not accepted
    assert message == "the trunk is tilted by 1.40 rad, limit 1.05"


def test_a_stale_state_refuses_standing_up(rig: Rig) -> None:
    rig.tick(age=0.2)
    accepted, message = rig.supervisor.request("stand_up")
    assert not accepted
    assert message == "the state is 200 ms old, limit 50 ms"


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


def test_a_second_publisher_of_states_keeps_the_joints_damped(policy: Any) -> None:
    rig = Rig(policy, auto_stand=True)
    rig.inputs["duplicate_publisher"] = "low_state has 2 publishers"
    rig.run(0.1)
    assert rig.mode == "passive"
    assert rig.supervisor.request("stand_up") == (False, "low_state has 2 publishers")
    rig.inputs["duplicate_publisher"] = None
    rig.run(2.5)
    assert rig.mode == "stance"
    rig.inputs["duplicate_publisher"] = "low_state has 2 publishers"
    rig.tick()
    assert (rig.mode, rig.supervisor.reason) == ("fault", "low_state has 2 publishers")


def test_a_fault_from_outside_is_latched_and_the_first_reason_stays(rig: Rig) -> None:
    rig.walk()
    rig.supervisor.fail("a test", "test")
    rig.supervisor.fail("another", "another")
    assert_damping(rig.tick(FORWARD))
    assert rig.supervisor.reason == "a test"


def test_a_damped_robot_does_not_enter_fault(rig: Rig) -> None:
    rig.tick()
    rig.supervisor.fail("a test", "test")
    assert rig.mode == "passive"


def test_passive_clears_a_fault_and_nothing_else_does(rig: Rig) -> None:
    rig.walk()
    rig.tick(age=1.0)
    accepted, message = rig.supervisor.request("stand_up")
    assert not accepted
    assert message == "the robot is in fault (the state is 1000 ms old, limit 50 ms), request passive first"
    assert rig.supervisor.request("passive")[0]
    rig.stand()


def test_the_policy_is_reset_on_entry_on_a_fault_and_after_a_gap(rig: Rig) -> None:
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
    rig = Rig(make_policy(nominal_q=tuple(ALIENGO.upper)), WITHOUT_ENCODERS, max_posture_error=1.5)
    rig.tick()
    rig.supervisor.request("stand_up")
    for _ in range(500):
        assert (rig.tick().q <= ALIENGO.command_upper).all()
    assert rig.mode == "stance"


def test_targets_of_the_policy_beyond_the_range_become_torque(policy: Any) -> None:
    rig = Rig(policy, WITHOUT_ENCODERS).walk()
    rig.run(0.2)
    rig.policy.action = np.full(12, 4.0, np.float32)
    wanted = rig.policy.metadata.action.targets(rig.policy.action)
    for _ in range(4):  # torque grows by 30 N m a tick
        rig.tick(FORWARD, q=ALIENGO.nominal_q)
    np.testing.assert_allclose(rig.answer.q, np.minimum(wanted, ALIENGO.command_upper), rtol=1e-12)
    np.testing.assert_allclose(rig.answer.target, wanted)
    rig.policy.action = np.full(12, 1e6, np.float32)
    rig.run(0.02, FORWARD)
    np.testing.assert_array_less(rig.answer.q, ALIENGO.command_upper + 1e-9)
    np.testing.assert_array_less(rig.answer.tau, ALIENGO.torque_limit + 1e-9)


LIMITS = [
    name
    for name, field in parameter_fields(ControlConfig).items()
    if not isinstance(field.default, bool) and name != "max_velocity_trim"  # 0 turns the trim off
]


@pytest.mark.parametrize("value", [0.0, -1.0, 1.0e300, math.inf, math.nan])
@pytest.mark.parametrize("field", LIMITS)
def test_a_limit_that_protects_nothing_is_refused_with_the_value_and_the_bound(
    field: str, value: float
) -> None:
    found = rf"^{field}: found {re.escape(str(value))}"
    with pytest.raises(
        ValueError, match=f"{found}, expected (a whole number, )?above 0 and at most [0-9.]+$"
    ):
        make_record(ControlConfig, {field: value})


@pytest.mark.parametrize(
    ("field", "value"),
    [("max_tilt", 1.6), ("max_torque_error", 1e4), ("stuck_torque", 1.01), ("max_power", 1e6)],
)
def test_a_limit_that_no_robot_reaches_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=field):
        make_record(ControlConfig, {field: value})


@pytest.mark.parametrize(
    ("field", "value"), [("max_torque_step", 89.0), ("max_torque_error", 45.0), ("max_power", 1e4)]
)
def test_a_limit_beyond_the_drives_of_the_robot_is_refused(policy: Any, field: str, value: float) -> None:
    expected = rf"^{field}: found {value}, expected at most [0-9.]+, what the drives of AlienGo can do$"
    with pytest.raises(ValueError, match=expected):
        Supervisor(ALIENGO, policy, make_record(SupervisorConfig, {field: value}))


def test_limits_of_the_command_come_from_the_policy(metadata: PolicyMetadata, rig: Rig) -> None:
    rig.walk()
    rig.tick((-9.0, 9.0, -9.0, 0.0))
    low, high = metadata.limits.low, metadata.limits.high
    np.testing.assert_array_equal(rig.supervisor.command, [low[0], high[1], low[2], 0.0])


def test_velocity_commands_are_limited_together_by_the_curve_limit(make_policy: Callable[..., Any]) -> None:
    rig = Rig(make_policy(curve_limit=0.6))  # -1 to 1.5, 0.5 m/s, 1 rad/s
    rig.walk()
    for command, expected in (
        ((0.0, 0.0, 9.0), (0.0, 0.0, 1.0)),
        ((1.5, 0.0, 1.0), (1.5, 0.0, 0.0)),
        ((0.75, 0.0, -1.0), (0.75, 0.0, -0.6 * np.sqrt(0.75) / 0.75)),
        ((0.75, 0.25, 1.0), (0.75, 0.25, 0.6 * np.sqrt(0.5) / np.hypot(0.75, 0.25))),
        ((0.75, -0.25, 0.2), (0.75, -0.25, 0.2)),
        ((9.0, 9.0, 1.0), (1.5 / np.sqrt(2), 0.5 / np.sqrt(2), 0.0)),
        ((-1.0, 0.5, 0.0), (-1.0 / np.sqrt(2), 0.5 / np.sqrt(2), 0.0)),
    ):
        rig.tick((*command, 0.0))
        np.testing.assert_allclose(rig.supervisor.command, [*expected, 0.0], atol=1e-12, err_msg=str(command))
