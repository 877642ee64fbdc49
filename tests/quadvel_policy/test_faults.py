"""Every row of the table of faults: its cause, response and reaction time, and that its guard detects it."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest

from quadvel_description.state import JointCommand, RobotState
from quadvel_policy import command_limits
from quadvel_policy.command_limits import LIMITS, JointCommandLimiter
from quadvel_policy.faults import page, table
from quadvel_policy.guard import Guard, Level
from quadvel_policy.guards import GUARDS
from quadvel_policy.guards.legs import EncoderInconsistent
from quadvel_policy.supervisor import SUPERVISOR_FAULTS
from quadvel_policy.tick_input import MotorStatus, TickInput
from tests.helpers.robots import ALIENGO
from tests.quadvel_policy.rig import FORWARD, PERIOD, STILL, Rig, assert_damping

Changes = dict[str, Any]
"""Changes of the state of one tick, its age, or the time since the previous one"""
NOT_A_NUMBER = np.full(12, np.nan)


@attrs.frozen
class Case:
    """How a fault comes about: what `bring` changes at tick k of it, within how many seconds it has to be found."""

    bring: Callable[[Rig, int], Changes]
    seconds: float = PERIOD
    mend: Callable[[Rig], None] = lambda rig: None


class Backup:
    """A filter with a settable velocity, which fails if that is not finite."""

    def __init__(self) -> None:
        self.velocity = np.zeros(3)

    def reset(self) -> None:
        """Nothing to forget."""

    def update_series(self, times: Any, states: Any) -> tuple[np.ndarray, np.ndarray]:
        if not np.isfinite(self.velocity).all():
            raise FloatingPointError("the filter has no velocity")
        return self.velocity, np.eye(3)


def moved(joint: int, by: float) -> Callable[[Rig, int], Changes]:
    return lambda rig, k: {"q": rig.state.q + by * (np.arange(12) == joint)}


def stirred(rig: Rig, k: int) -> None:
    """Let the policy move all joints, and the trunk a little, as walking does."""
    rig.policy.action = np.full(12, 0.8 * math.sin(0.3 * k), np.float32)


def stirring(**changes: Any) -> Callable[[Rig, int], Changes]:
    def bring(rig: Rig, k: int) -> Changes:
        stirred(rig, k)
        return changes

    return bring


def stuck_encoder(rig: Rig, k: int) -> Changes:
    stirred(rig, k)
    still = np.arange(12) == 5
    return {"q": np.where(still, ALIENGO.nominal_q, rig.state.q), "dq": np.where(still, 0.01, rig.state.dq)}


def stuck_tick(rig: Rig, k: int) -> Changes:
    return {"tick": 7}


def giving_way(rig: Rig, joint: int, by: float, k: int) -> RobotState:
    """The state in which a joint yields by `by` rad within 0.15 s, as its encoder sees it, with some noise."""
    if k == 0:
        rig.base = rig.state.q.copy()
    share, there = min(k / 30, 1.0), np.arange(12) == joint
    noise = 1e-6 * (-1.0) ** k
    speed = by / 0.15 if share < 1.0 else 0.0
    return attrs.evolve(rig.state, q=rig.base + there * by * share + noise, dq=there * speed)


def ideal_torque(command: JointCommand, state: RobotState) -> np.ndarray:
    """What an ideal drive gives, N m."""
    return np.clip(command.torque(state.q, state.dq), -ALIENGO.torque_limit, ALIENGO.torque_limit)


def silent_drive(rig: Rig, k: int) -> Changes:
    """A knee sags as its drive gives nothing, while the others report what they give."""
    seen = giving_way(rig, 2, -0.9, k)
    return {
        "q": seen.q,
        "dq": seen.dq,
        "tau": np.where(np.arange(12) == 2, 0.0, ideal_torque(rig.answer, seen)) + 1e-3,
    }


def stuck_joint(rig: Rig, k: int) -> Changes:
    """A knee that was bent by something pushes with all it has and stays where it is."""
    rig.policy.action = np.where(np.arange(12) == 8, 6.0, 0.0).astype(np.float32)
    seen = giving_way(rig, 8, -0.7, k)
    return {"q": seen.q, "dq": seen.dq, "tau": ideal_torque(rig.answer, seen)}


def stopped(rig: Rig, seconds: float) -> Changes:
    """The controller does not run for this long, while the robot continues."""
    rig.inputs["stopped"] = seconds
    return {"step": seconds}


def motors(rig: Rig, temperature: float = 40.0, dropped_out: int | None = None) -> Changes:
    rig.inputs["motors"] = MotorStatus(np.full(12, temperature), np.arange(12) == dropped_out)
    return {}


def attribute(name: str, value: Any) -> Callable[[Rig, int], Changes]:
    def bring(rig: Rig, k: int) -> Changes:
        rig.inputs[name] = value
        return {}

    return bring


def no_velocity(rig: Rig, k: int) -> Changes:
    rig.velocity = None
    return {}


def neither_velocity(rig: Rig, k: int) -> Changes:
    rig.backup.velocity = np.full(3, np.nan)
    rig.velocity = None if k > 1 else rig.velocity
    return {}


def wrong_velocity(rig: Rig, k: int) -> Changes:
    rig.velocity = np.array([1.5, 0.0, 0.0])
    return {}


def right_velocity(rig: Rig) -> None:
    rig.velocity, rig.backup.velocity = np.zeros(3), np.zeros(3)


def cool(rig: Rig) -> None:
    rig.inputs.clear()


CASES: dict[str, Case] = {
    "duplicate_publisher": Case(attribute("duplicate_publisher", "low_state has 2 publishers")),
    "state_not_finite": Case(lambda rig, k: {"dq": NOT_A_NUMBER}),
    "state_stale": Case(lambda rig, k: {"age": 0.06}),
    "controller_stopped": Case(lambda rig, k: stopped(rig, 0.2)),
    "state_back_in_time": Case(lambda rig, k: {"step": -0.01}),
    "state_frozen": Case(stuck_tick, 0.035),
    "attitude_not_unit": Case(lambda rig, k: {"quaternion": np.zeros(4)}),
    "tilted": Case(lambda rig, k: {"quaternion": np.array([math.cos(0.6), 0.0, math.sin(0.6), 0.0])}),
    "joint_out_of_range": Case(
        lambda rig, k: {"q": np.where(np.arange(12) == 5, ALIENGO.upper + 0.5, rig.state.q)}
    ),
    "joint_too_fast": Case(lambda rig, k: {"dq": np.full(12, 50.0)}),
    "encoder_inconsistent": Case(moved(5, 0.4), 2 * PERIOD),
    "encoder_frozen": Case(stuck_encoder, 0.15),
    "imu_inconsistent": Case(
        lambda rig, k: {
            "angular_velocity": np.array([0.0, 0.0, 1.5]),
            "quaternion": np.array([1.0, 0, 0, 0]),
        },
        0.2,
    ),
    "drive_does_not_answer": Case(silent_drive, 0.3),
    "joint_stuck": Case(stuck_joint, 0.8),
    "motor_dropped_out": Case(lambda rig, k: motors(rig, dropped_out=7)),
    "imu_frozen": Case(stirring(angular_velocity=np.array([0.01, 0.0, 0.0])), 0.15),
    "accelerometer_implausible": Case(
        lambda rig, k: {"linear_acceleration": np.array([30.0, 0.0, 9.81])}, 0.2
    ),
    "motor_hot": Case(lambda rig, k: motors(rig, temperature=90.0), mend=cool),
    "overruns": Case(attribute("overruns", 21), mend=cool),
    "no_velocity": Case(neither_velocity, 3 * PERIOD, right_velocity),
    "estimate_stale": Case(no_velocity, mend=right_velocity),
    "estimate_wrong": Case(wrong_velocity, 0.11, right_velocity),
    "foot_force_frozen": Case(lambda rig, k: {}, 1.05),
}
"""Of the guards, by name"""


WALKING: dict[tuple[type[Guard], ...], Rig] = {}


def walking(policy: Any, guards: tuple[type[Guard], ...] = GUARDS) -> Rig:
    """A robot that walks, a copy of the first one: coming there takes 500 ticks."""
    if guards not in WALKING:
        backup = Backup()
        WALKING[guards] = Rig(policy, guards, backup)
        WALKING[guards].backup = backup
        WALKING[guards].walk()
    return deepcopy(WALKING[guards])


def found(rig: Rig, name: str) -> bool:
    return rig.supervisor.fault == name or any(f.name == name for f in rig.supervisor.findings)


def until_found(rig: Rig, case: Case, name: str) -> float:
    """Seconds until the guard `name` finds the fault. AssertionError where it takes longer than it may."""
    for k in range(round(case.seconds / PERIOD)):
        rig.tick(FORWARD, **case.bring(rig, k))
        if found(rig, name):
            return (k + 1) * PERIOD
    raise AssertionError(f"{name} was not found; {rig.mode}: {rig.supervisor.reason}")


def check_row(policy: Any, guard: type[Guard], guards: tuple[type[Guard], ...]) -> None:
    """All that the table promises of one guard. AssertionError where it does not hold."""
    name, case = guard.name(), CASES[guard.name()]
    rig = walking(policy, guards)
    until_found(rig, case, name)
    {
        Level.DAMPING: check_damping,
        Level.STANCE: check_stance,
        Level.LIMIT: check_comes_back,
        Level.NOTICE: check_comes_back,
    }[guard.level](rig, case, name)


def check_damping(rig: Rig, case: Case, name: str) -> None:
    assert (rig.mode, rig.supervisor.fault) == ("fault", name)
    assert_damping(rig.answer)
    reason = rig.supervisor.reason
    rig.run(0.3, FORWARD)
    assert (rig.mode, rig.supervisor.reason) == ("fault", reason)
    assert rig.supervisor.request("stand_up") == (
        False,
        f"the robot is in fault ({reason}), request passive first",
    )
    rig.inputs.clear()
    assert rig.supervisor.request("passive")[0]
    rig.policy.action = np.zeros(12, np.float32)
    rig.walk()
    assert rig.supervisor.fault == ""


def check_stance(rig: Rig, case: Case, name: str) -> None:
    assert (rig.mode, rig.supervisor.fault) == ("walk", name)
    sentence = rig.supervisor.reason
    for k in range(160):
        rig.tick(FORWARD, **case.bring(rig, k))
        np.testing.assert_array_equal(rig.supervisor.command, STILL)  # the policy brakes
    assert (rig.mode, rig.supervisor.fault) == ("stance", name)
    for k in range(160, 260):
        moving = case.bring(rig, k) if name != "imu_frozen" else {}  # whose joints stand still by now
        rig.tick(STILL if k % 2 else FORWARD, **moving)
    assert rig.mode == "stance"
    assert sentence in rig.supervisor.walk_refusal
    assert not rig.supervisor.request("walk")[0]
    if name != "imu_frozen":
        rig.tick(**case.bring(rig, 0))
        accepted, message = rig.supervisor.request("stance")
        assert not accepted
        assert "still there" in message
    case.mend(rig)
    rig.run(2.0, FORWARD)
    assert rig.mode == "stance"  # the operator has the say
    assert rig.supervisor.request("stance") == (True, "mode is stance")
    rig.run(0.1, FORWARD)
    assert rig.supervisor.walk_refusal == "a zero velocity has to be commanded first"
    rig.tick(STILL)
    rig.run(0.1, FORWARD)
    assert (rig.mode, rig.supervisor.fault) == ("walk", "")


def check_comes_back(rig: Rig, case: Case, name: str) -> None:
    assert (rig.mode, rig.supervisor.fault) == ("walk", "")
    case.mend(rig)
    for k in range(220):
        force = rig.state.foot_force + k
        rig.tick(FORWARD, foot_force=force)
    assert not found(rig, name)
    assert rig.mode == "walk"


@pytest.mark.parametrize("guard", GUARDS, ids=lambda guard: guard.name())
def test_each_guard_does_what_its_row_says(policy: Any, guard: type[Guard]) -> None:
    check_row(policy, guard, GUARDS)


@pytest.mark.parametrize("guard", GUARDS, ids=lambda guard: guard.name())
def test_without_the_guard_its_row_does_not_hold(policy: Any, guard: type[Guard]) -> None:
    """The mutation: each guard is needed, and no other one does its work under its name."""
    with pytest.raises(AssertionError):
        check_row(policy, guard, tuple(other for other in GUARDS if other is not guard))


@pytest.mark.parametrize(("missed", "fault"), [(10, ""), (30, "overruns")])
def test_drives_that_brake_because_commands_are_late_are_not_reported_as_silent(
    policy: Any, missed: int, fault: str
) -> None:
    rig = Rig(policy).stand()
    rig.inputs["overruns"] = missed
    for k in range(60):
        rig.tick(**silent_drive(rig, k))
    assert rig.supervisor.fault == fault
    rig.inputs["overruns"] = 0
    for k in range(60):
        rig.tick(**silent_drive(rig, k))
    assert rig.supervisor.fault == "drive_does_not_answer"


@pytest.mark.parametrize("guard", [g for g in GUARDS if g.level is Level.DAMPING], ids=lambda g: g.name())
@pytest.mark.parametrize("mode", ["stand_up", "stance", "lie_down"])
def test_postures_are_guarded_as_walking_is(policy: Any, guard: type[Guard], mode: str) -> None:
    name = guard.name()
    if name == "encoder_frozen" and mode == "stance":
        pytest.skip("a joint that is asked to stand still may do so")
    rig = Rig(policy).stand()
    if mode != "stance":
        rig.supervisor.request("passive" if mode == "stand_up" else mode)
        rig.tick()
        rig.supervisor.request(mode)
    rig.tick()
    assert rig.mode == mode
    until_found(rig, attrs.evolve(CASES[name], seconds=CASES[name].seconds + 0.3), name)
    assert (rig.mode, rig.supervisor.fault) == ("fault", name)
    assert_damping(rig.answer)


@pytest.mark.parametrize("name", CASES)
def test_a_passive_robot_may_be_handled_in_any_way(policy: Any, name: str) -> None:
    backup = Backup()
    rig = Rig(policy, backup=backup)
    rig.backup = backup
    rig.tick()
    for k in range(round(CASES[name].seconds / PERIOD) + 1):
        assert_damping(rig.tick(**CASES[name].bring(rig, k)))
    assert rig.mode == "passive"


def test_a_walking_robot_follows_the_kalman_filter_where_the_estimate_is_missing_or_wrong(
    policy: Any,
) -> None:
    rig = walking(policy)
    rig.backup.velocity = np.array([0.4, 0.1, 0.0])
    rig.velocity = np.array([0.5, 0.1, 0.0])
    rig.run(0.1, FORWARD)
    np.testing.assert_allclose(rig.policy.seen[-1][30:33], rig.velocity, atol=1e-6)
    rig.velocity = None
    rig.run(0.1, FORWARD)
    np.testing.assert_allclose(rig.policy.seen[-1][30:33], rig.backup.velocity, atol=1e-6)
    rig.velocity = np.array([5.0, 0.0, 0.0])
    rig.run(0.2, FORWARD)
    np.testing.assert_allclose(rig.policy.seen[-1][30:33], rig.backup.velocity, atol=1e-6)


def test_the_command_is_trimmed_by_the_kalman_filter_and_without_it_by_the_estimate(policy: Any) -> None:
    rig = walking(policy)
    rig.velocity, rig.backup.velocity = np.array([0.55, 0.0, 0.0]), np.array([0.45, 0.0, 0.0])
    rig.run(4.0, FORWARD)
    assert rig.supervisor.trim[0] > 0.05
    rig.backup.velocity = np.full(3, np.nan)
    rig.run(6.0, FORWARD)
    assert rig.supervisor.trim[0] < -0.05


def test_a_robot_that_knows_no_velocity_brakes_on_what_is_left_of_the_last_one(policy: Any) -> None:
    rig = walking(policy)
    rig.velocity = rig.backup.velocity = np.array([1.0, 0.0, 0.0])
    rig.run(0.1, FORWARD)
    rig.velocity, rig.backup.velocity = None, np.full(3, np.nan)
    rig.run(0.2, FORWARD)
    assert 0.2 < rig.policy.seen[-1][30] < 0.5
    rig.run(1.2, FORWARD)
    assert rig.mode == "stance"


def test_a_fault_while_standing_up_does_not_stop_in_the_middle_and_forbids_walking_after_it(
    policy: Any,
) -> None:
    rig = Rig(policy)
    rig.tick()
    rig.supervisor.request("stand_up")
    rig.run(0.5)
    motors(rig, temperature=95.0)
    rig.run(2.0)
    assert (rig.mode, rig.supervisor.fault) == ("stance", "motor_hot")
    rig.run(0.5, FORWARD)
    assert rig.mode == "stance"
    assert rig.supervisor.request("lie_down")[0]


# What the supervisor notices itself, and the limits of commands.


def test_standing_up_that_ends_elsewhere_is_a_fault(policy: Any) -> None:
    rig = Rig(policy, max_posture_error=0.3)
    rig.tick()
    rig.supervisor.request("stand_up")
    for k in range(450):
        rig.tick(q=np.where(np.arange(12) == 5, -2.5 + 1e-6 * (-1) ** k, rig.state.q))
    assert (rig.mode, rig.supervisor.fault) == ("fault", "stand_up_failed")
    assert "off the nominal posture" in rig.supervisor.reason


def test_an_action_that_is_not_finite_is_a_fault(policy: Any) -> None:
    rig = walking(policy)
    rig.policy.action = np.full(12, np.nan, np.float32)
    assert_damping(rig.tick(FORWARD))
    assert (rig.mode, rig.supervisor.fault) == ("fault", "policy_not_finite")


@pytest.mark.parametrize(
    ("command", "name"),
    [
        (None, "command_stale"),
        ((math.nan, 0.0, 0.0, 0.0), "command_not_finite"),
        ((99.0, 0.0, 0.0, 0.0), "command_out_of_range"),
    ],
)
def test_an_unfit_command_is_reported_and_limited(policy: Any, command: Any, name: str) -> None:
    rig = walking(policy)
    rig.tick(command)
    assert rig.mode == "walk"
    assert [finding.name for finding in rig.supervisor.findings] == [name]
    limit = policy.metadata.limits.high[0]
    np.testing.assert_array_equal(
        rig.supervisor.command, [limit, 0, 0, 0] if name == "command_out_of_range" else STILL
    )
    rig.tick(FORWARD)
    assert not rig.supervisor.findings


def asked_torque(command: JointCommand, rig: Rig) -> np.ndarray:
    return command.tau + command.kp * (command.q - rig.seen.q) + command.kd * (command.dq - rig.seen.dq)


LIMIT_CASES: dict[str, tuple[float, Changes]] = {
    "target_out_of_range": (4.0, {}),
    "torque_jumps": (-4.0, {}),
    "torque_too_large": (40.0, {}),
    "joint_at_speed_limit": (6.0, {"dq": 1.2 * ALIENGO.velocity_limit}),
    "power_too_large": (8.0, {"dq": np.full(12, 14.0)}),
}
"""What the policy answers, and what is changed of the state"""


def check_limit(policy: Any, name: str) -> None:
    rig = Rig(policy, [guard for guard in GUARDS if guard is not EncoderInconsistent]).walk()
    rig.run(0.2, FORWARD)
    action, changes = LIMIT_CASES[name]
    command = rig.answer
    for k in range(6):
        before = command
        rig.policy.action = np.full(12, action * (-1) ** (k * (name == "torque_jumps")), np.float32)
        time, tick = rig.state.time + (k + 1) * PERIOD, rig.state.tick + 5 * (k + 1)
        rig.seen = attrs.evolve(rig.state, time=time, tick=tick, q=ALIENGO.nominal_q, **changes)
        command = rig.supervisor.tick(TickInput(time, rig.seen, rig.velocity, FORWARD))
        torque = asked_torque(command, rig)
        power = np.maximum(torque * rig.seen.dq, 0.0).sum()
        assert np.abs(torque).max() <= ALIENGO.torque_limit.max() + 1e-9
        assert (np.abs(torque) <= ALIENGO.torque_limit + 1e-9).all()
        assert power <= 1800.0 + 1e-6
        assert not ((np.abs(rig.seen.dq) > ALIENGO.velocity_limit) & (torque * rig.seen.dq > 1e-9)).any()
        assert (command.q >= command_limits.clip_to_command_range(ALIENGO, command.q) - 1e-12).all()
        if k:
            assert command.mode == before.mode
            assert np.abs(torque - asked_torque(before, rig)).max() <= 30.0 + 1e-9
    assert rig.supervisor.limits[name] > 0


@pytest.mark.parametrize("name", LIMITS)
def test_no_command_leaves_beyond_a_limit(policy: Any, name: str) -> None:
    check_limit(policy, name)


MUTATED = {
    "torque_jumps": "_limit_step",
    "torque_too_large": "_limit_torque",
    "joint_at_speed_limit": "_limit_at_top_speed",
    "power_too_large": "_limit_power",
}


@pytest.mark.parametrize("name", MUTATED)
def test_without_a_limit_a_command_leaves_beyond_it(
    policy: Any, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(JointCommandLimiter, MUTATED[name], lambda self, torque, *_: torque)
    with pytest.raises(AssertionError):
        check_limit(policy, name)


def test_the_table_has_a_row_for_each_guard_limit_and_other_fault() -> None:
    names = [row.name for row in table()]
    assert sorted(names) == sorted([*CASES, *LIMITS, *SUPERVISOR_FAULTS])
    assert len(set(names)) == len(names)


def test_the_page_of_faults_is_what_the_code_prints() -> None:
    printed = Path(__file__).parents[2] / "docs" / "faults.md"
    assert printed.read_text() == page(), "run: python -m quadvel_policy.faults > docs/faults.md"


def test_a_simulated_robot_goes_on_after_states_that_were_lost(policy: Any) -> None:
    """A loaded machine had no time to read them: only a silence of `max_standstill` is a fault there."""
    rig = Rig(policy, robot_waits=True).stand()
    rig.tick(step=0.075)
    assert rig.mode == "stance", rig.supervisor.reason
    rig.tick(step=1.1)
    assert rig.supervisor.fault == "state_stale"
