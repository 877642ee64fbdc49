from __future__ import annotations

import pytest

from quadvel_eval.script import LIE_DOWN, SCRIPTS, STAND_UP, Drive, ScriptError, ScriptRunner

WALK = Drive("forward", (0.5, 0.0, 0.0), 2.0)


def test_a_script_is_walked_step_by_step() -> None:
    runner = ScriptRunner((STAND_UP, WALK, LIE_DOWN))
    assert runner.update(0.0, "").requested_mode is None  # no robot is there to be commanded
    assert runner.update(0.1, "passive").requested_mode == "stand_up"
    assert runner.update(0.2, "stand_up").velocity is None
    assert runner.update(3.0, "stance").velocity == WALK.velocity
    assert runner.update(4.9, "walk").velocity == WALK.velocity
    assert runner.update(5.1, "walk").requested_mode == "lie_down"
    assert runner.update(5.2, "lie_down").requested_mode is None
    assert runner.update(7.0, "passive") is None
    assert runner.update(7.1, "passive") is None


def test_a_mode_is_requested_until_the_controller_follows() -> None:
    runner = ScriptRunner((STAND_UP,))
    modes = ("", "passive", "passive", "stand_up", "stand_up")
    assert [runner.update(float(t), mode).requested_mode for t, mode in enumerate(modes)] == [
        *(None, "stand_up", "stand_up", None, None),
    ]


def test_a_standing_robot_gets_no_request_to_stand_up() -> None:
    assert ScriptRunner((STAND_UP, WALK)).update(0.0, "stand_up").requested_mode is None
    runner = ScriptRunner((STAND_UP, WALK))
    assert runner.update(0.0, "stance").requested_mode is None
    assert runner.update(0.1, "stance").velocity == WALK.velocity


def test_the_walk_begins_when_the_controller_follows_velocities() -> None:
    runner = ScriptRunner((STAND_UP, WALK))
    runner.update(0.0, "stand_up", walk_refusal="mode is stand_up")
    for t in (3.0, 3.1):
        assert runner.update(t, "stance", walk_refusal="a zero velocity is missing").velocity == (
            0.0,
            0.0,
            0.0,
        )
    assert runner.update(3.2, "stance").velocity == WALK.velocity
    runner = ScriptRunner((STAND_UP, WALK))
    runner.update(0.0, "stance", walk_refusal="not allowed")
    with pytest.raises(ScriptError, match="not allowed"):
        runner.update(20.1, "stance", walk_refusal="not allowed")


def test_a_fault_ends_the_script_with_the_controllers_reason() -> None:
    with pytest.raises(ScriptError, match="the trunk is tilted"):
        ScriptRunner((WALK,)).update(0.0, "fault", "the trunk is tilted by 1.20 rad")


def test_a_mode_request_times_out() -> None:
    runner = ScriptRunner((STAND_UP,))
    runner.update(0.0, "passive")
    with pytest.raises(ScriptError, match=r"'stand up' took more than 20 s; the mode is passive"):
        runner.update(20.1, "passive")


def test_a_robot_that_lies_down_in_the_middle_is_an_error() -> None:
    runner = ScriptRunner((WALK,))
    runner.update(0.0, "walk")
    with pytest.raises(ScriptError, match="mode passive during 'forward'"):
        runner.update(0.5, "passive", "was asked for")


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_stand_up_first_stop_and_lie_down_last(name: str) -> None:
    first, *_, stop, last = SCRIPTS[name]
    assert (first, last) == (STAND_UP, LIE_DOWN)
    assert isinstance(stop, Drive)
    assert stop.velocity == (0.0, 0.0, 0.0)
