"""Which source wins, how fast the command changes, and when the robot is asked to stand still."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quadvel_policy.command_mux import CommandMux, MuxConfig, MuxInput, MuxOutput

TELEOP, PLANNER = MuxInput("teleop", 100, 0.5), MuxInput("planner", 10, 0.3)
FORWARD, BACK = (1.0, 0.0, 0.0), (-0.5, 0.0, 0.0)
PERIOD = 0.02
BRISK = MuxConfig(acceleration=(5.0, 5.0, 10.0))


@pytest.fixture
def mux() -> CommandMux:
    return CommandMux([PLANNER, TELEOP], BRISK)


def run(mux: CommandMux, start: float, seconds: float, **heard: Any) -> MuxOutput:
    """Update at 50 Hz; the inputs of `heard` speak before every update."""
    for i in range(1, round(seconds / PERIOD) + 1):
        now = start + i * PERIOD
        for name, velocity in heard.items():
            mux.receive(name, now, velocity)
        output = mux.update(now)
    return output


def test_silence_from_the_start_is_stance(mux: CommandMux) -> None:
    output = mux.update(10.0)
    np.testing.assert_array_equal(output.velocity, np.zeros(3))
    assert (output.stance, output.source) == (True, "none")


def test_the_highest_priority_that_speaks_wins(mux: CommandMux) -> None:
    output = run(mux, 0.0, 1.0, teleop=FORWARD, planner=BACK)
    np.testing.assert_allclose(output.velocity, FORWARD)
    assert (output.stance, output.source) == (False, "teleop")


def test_the_next_one_takes_over_when_the_first_falls_silent(mux: CommandMux) -> None:
    run(mux, 0.0, 1.0, teleop=FORWARD, planner=BACK)
    output = run(mux, 1.0, 0.5, planner=BACK)
    assert output.source == "teleop"  # silent for 0.5 s exactly
    output = run(mux, 1.5, 1.0, planner=BACK)
    np.testing.assert_allclose(output.velocity, BACK)
    assert output.source == "planner"


def test_a_mux_that_could_not_run_does_not_let_the_command_jump(mux: CommandMux) -> None:
    run(mux, 0.0, 0.1, teleop=(0.0, 0.0, 0.0))
    mux.receive("teleop", 0.5, FORWARD)
    np.testing.assert_allclose(mux.update(0.5).velocity, [0.25, 0.0, 0.0])  # 5 m/s^2 for 50 ms, not for 400


def test_the_command_changes_no_faster_than_allowed(mux: CommandMux) -> None:
    run(mux, 0.0, 0.02, teleop=(0.0, 0.0, 0.0))
    output = run(mux, 0.02, 0.02, teleop=(2.0, 0.5, 0.0))
    np.testing.assert_allclose(output.velocity, [0.1, 0.025, 0.0])  # 5 m/s^2, on a straight line


def test_silence_ramps_to_zero_and_then_asks_for_stance(mux: CommandMux) -> None:
    run(mux, 0.0, 1.0, teleop=FORWARD)
    output = run(mux, 1.0, 0.5 + 0.1)
    np.testing.assert_allclose(output.velocity, [1.0 - 2.0 * 0.1, 0.0, 0.0])
    assert (output.stance, output.source) == (False, "none")
    assert not run(mux, 1.6, 0.38).stance
    output = run(mux, 1.98, 0.06)
    assert output.stance
    np.testing.assert_array_equal(output.velocity, np.zeros(3))


@pytest.mark.parametrize("stop", ["lock", "stance"])
def test_a_lock_and_a_request_for_stance_stop_a_speaking_source(mux: CommandMux, stop: str) -> None:
    run(mux, 0.0, 1.0, teleop=FORWARD)
    if stop == "lock":
        mux.locks.add("lock")
    else:
        mux.stance_requested = True
    output = run(mux, 1.0, 0.2, teleop=FORWARD)
    np.testing.assert_allclose(output.velocity, [0.6, 0.0, 0.0])
    output = run(mux, 1.2, 0.4, teleop=FORWARD)
    assert (output.stance, output.source) == (True, "none")
    mux.locks.clear()
    mux.stance_requested = False
    output = run(mux, 1.6, 0.4, teleop=FORWARD)
    np.testing.assert_allclose(output.velocity, FORWARD)
    assert not output.stance


def test_a_command_in_the_dead_zone_is_stance_after_the_ramp(mux: CommandMux) -> None:
    run(mux, 0.0, 1.0, teleop=FORWARD)
    output = run(mux, 1.0, 0.04, teleop=(0.01, -0.01, 0.015))
    assert not output.stance
    output = run(mux, 1.04, 0.3, teleop=(0.01, -0.01, 0.015))
    assert (output.stance, output.source) == (True, "teleop")
    output = run(mux, 1.34, 0.3, teleop=(0.0, 0.0, 0.03))
    assert not output.stance


def test_a_reversal_is_no_stance(mux: CommandMux) -> None:
    run(mux, 0.0, 1.0, teleop=FORWARD)
    for i in range(1, 40):
        mux.receive("teleop", 1.0 + i * PERIOD, BACK)
        assert not mux.update(1.0 + i * PERIOD).stance


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused_and_change_nothing(mux: CommandMux, bad: float) -> None:
    run(mux, 0.0, 1.0, planner=FORWARD)
    with pytest.raises(ValueError, match=r"teleop: the velocity is \[0.0, .*\], expected finite numbers"):
        mux.receive("teleop", 1.0, (0.0, bad, 0.0))
    output = run(mux, 1.0, 0.1, planner=FORWARD)
    assert output.source == "planner"
    np.testing.assert_allclose(output.velocity, FORWARD)


def test_a_velocity_beyond_the_bounds_is_held_to_them(mux: CommandMux) -> None:
    output = run(mux, 0.0, 6.0, teleop=(1e30, -7.0, 99.0))
    np.testing.assert_allclose(output.velocity, [4.5, -2.2, 6.3])


def test_a_clock_that_is_set_back_makes_every_input_silent(mux: CommandMux) -> None:
    run(mux, 100.0, 1.0, teleop=FORWARD)
    first = mux.update(5.0)
    np.testing.assert_allclose(first.velocity, FORWARD)  # no time has passed yet
    assert run(mux, 5.0, 1.0).stance


@pytest.mark.parametrize(
    "inputs", [[], [TELEOP, MuxInput("teleop", 1, 1.0)], [TELEOP, MuxInput("a", 100, 1.0)]]
)
def test_inputs_that_can_not_be_told_apart_are_refused(inputs: list[MuxInput]) -> None:
    with pytest.raises(ValueError, match=r"inputs have the (name|priority) list .* expected each"):
        CommandMux(inputs)


@pytest.mark.parametrize("value", [(1.0, 2.0), (1.0, 0.0, 1.0), (1.0, np.nan, 1.0)])
def test_bounds_that_make_no_sense_are_refused_by_name(value: Any) -> None:
    with pytest.raises(ValueError, match=r"acceleration is .* expected three numbers above 0"):
        MuxConfig(acceleration=value)
    with pytest.raises(ValueError, match="timeout"):
        MuxInput("teleop", 1, 0.0)


VELOCITY = st.tuples(*[st.floats(-10, 10)] * 3)
EVENT = st.tuples(st.floats(0.0, 0.4), st.sampled_from(["teleop", "planner", "lock", "free"]), VELOCITY)


@given(st.lists(EVENT, max_size=40))
@settings(max_examples=60, deadline=None)
def test_whatever_happens_the_command_is_bounded_and_stance_means_zero(events: list[Any]) -> None:
    mux, now, last = CommandMux([TELEOP, PLANNER], BRISK), 0.0, np.zeros(3)
    for wait, kind, velocity in events:
        now += wait
        if kind in ("teleop", "planner"):
            mux.receive(kind, now, velocity)
        else:
            mux.locks = {"lock"} if kind == "lock" else set()
        output = mux.update(now)
        assert (np.abs(output.velocity) <= BRISK.max_velocity).all()
        assert (np.abs(output.velocity - last) <= np.multiply(BRISK.acceleration, wait) + 1e-9).all()
        assert not (output.stance and output.velocity.any())
        assert not (mux.locks and output.source != "none")
        last = output.velocity
    silent = [mux.update(now + wait) for wait in np.arange(0.05, 4.0, 0.05)]
    assert silent[-1].stance
