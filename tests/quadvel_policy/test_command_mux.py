"""Which source wins, how fast the command changes, and when the robot is asked to stand still."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quadvel_policy.command_mux import MAX_RAMP_STEP_S, CommandMux, MuxConfig, MuxInput, MuxOutput

TELEOP, PLANNER = MuxInput("teleop", 100, 0.5), MuxInput("planner", 10, 0.3)
FORWARD, BACK = (1.0, 0.0, 0.0), (-0.5, 0.0, 0.0)
PERIOD = 0.02
BRISK = MuxConfig(acceleration=(5.0, 5.0, 10.0), stop_acceleration=(2.0, 2.0, 4.0))


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


def test_the_active_source_with_the_highest_priority_wins(mux: CommandMux) -> None:
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


def test_braking_is_as_fast_for_a_command_as_for_a_stop(mux: CommandMux) -> None:
    run(mux, 0.0, 1.0, teleop=FORWARD)
    output = run(mux, 1.0, 0.1, teleop=(0.5, 0.0, 0.0))
    np.testing.assert_allclose(output.velocity, [1.0 - 2.0 * 0.1, 0.0, 0.0])


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
def test_a_lock_and_a_request_for_stance_stop_an_active_source(mux: CommandMux, stop: str) -> None:
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
    output = run(mux, 1.04, 0.6, teleop=(0.01, -0.01, 0.015))
    assert (output.stance, output.source) == (True, "teleop")
    output = run(mux, 1.64, 0.3, teleop=(0.0, 0.0, 0.03))
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


def test_a_velocity_beyond_the_bounds_is_clamped(mux: CommandMux) -> None:
    output = run(mux, 0.0, 6.0, teleop=(1e30, -7.0, 99.0))
    np.testing.assert_allclose(output.velocity, [4.5, -2.2, 6.3])


def test_a_clock_that_is_set_back_makes_every_input_silent(mux: CommandMux) -> None:
    run(mux, 100.0, 1.0, teleop=FORWARD)
    first = mux.update(5.0)
    np.testing.assert_allclose(first.velocity, FORWARD)  # no time has passed yet
    assert run(mux, 5.0, 1.0).stance


def test_a_velocity_from_before_the_clock_was_set_back_is_not_followed_later(
    mux: CommandMux,
) -> None:
    run(mux, 100.0, 1.0, teleop=FORWARD)
    mux.update(5.0)
    for now in np.arange(5.0, 102.0, PERIOD):
        output = mux.update(now)
        assert output.source == "none"
    assert output.stance


@pytest.mark.parametrize(
    "inputs", [[], [TELEOP, MuxInput("teleop", 1, 1.0)], [TELEOP, MuxInput("a", 100, 1.0)]]
)
def test_inputs_with_equal_names_or_priorities_are_refused(inputs: list[MuxInput]) -> None:
    with pytest.raises(ValueError, match=r"inputs have the (name|priority) list .* expected each"):
        CommandMux(inputs)


@pytest.mark.parametrize("value", [(1.0, 2.0), (1.0, 0.0, 1.0), (1.0, np.nan, 1.0)])
def test_bounds_that_make_no_sense_are_refused_by_name(value: Any) -> None:
    with pytest.raises(ValueError, match=r"acceleration is .* expected three numbers above 0"):
        MuxConfig(acceleration=value)
    with pytest.raises(ValueError, match="timeout"):
        MuxInput("teleop", 1, 0.0)


SPEED = st.floats(-10.0, 10.0) | st.floats(allow_nan=True, allow_infinity=True) | st.just(0.0)
VELOCITY = st.tuples(SPEED, SPEED, SPEED)
# s, in whole nanoseconds as ROS counts them; now and then the clock is set.
WAIT = (st.floats(0.0, 0.4) | st.just(0.0) | st.floats(-100.0, 100.0)).map(lambda wait: round(wait, 9))
SPEAKS = st.tuples(st.sampled_from([TELEOP, PLANNER]), VELOCITY)
STOPS = st.tuples(st.sampled_from(["lock", "other lock", "stance"]), st.booleans())
EVENTS = st.lists(st.tuples(WAIT, SPEAKS | STOPS), max_size=40)


class ReferenceMux:
    """A mux, and a simpler model of its inputs as the reference for its output."""

    def __init__(self) -> None:
        self.mux = CommandMux([TELEOP, PLANNER], BRISK)
        self.now, self.last = 0.0, self.mux.update(0.0)
        self.heard: dict[MuxInput, float] = {}

    def apply(self, event: tuple[Any, Any]) -> None:
        who, what = event
        if isinstance(who, MuxInput):
            if np.isfinite(what).all():
                self.mux.receive(who.name, self.now, what)
                self.heard[who] = self.now
            else:
                with pytest.raises(ValueError, match="expected finite numbers"):
                    self.mux.receive(who.name, self.now, what)
        elif who == "stance":
            self.mux.stance_requested = what
        else:
            (self.mux.locks.add if what else self.mux.locks.discard)(who)

    @property
    def stopped(self) -> bool:
        return bool(self.mux.locks) or self.mux.stance_requested

    def winner(self) -> str:
        """Return the fresh input with the highest priority, according to the model."""
        self.heard = {one: at for one, at in self.heard.items() if at <= self.now}
        fresh = [one.name for one, at in self.heard.items() if self.now - at <= one.timeout]
        return "none" if self.stopped or not fresh else "teleop" if "teleop" in fresh else "planner"

    def check(self, wait: float) -> MuxOutput:
        """One update after `wait` s, and all that holds of every one."""
        output = self.mux.update(self.now)
        limit = BRISK.stop_acceleration if output.source == "none" else BRISK.acceleration
        step = np.multiply(limit, np.clip(wait, 0.0, MAX_RAMP_STEP_S))
        assert np.isfinite(output.velocity).all()
        assert (np.abs(output.velocity) <= BRISK.max_velocity).all()
        assert (np.abs(output.velocity - self.last.velocity) <= step + 1e-9).all()
        assert output.source == self.winner()
        assert not (output.stance and output.velocity.any())
        self.last = output
        return output

    def pass_time(self, seconds: float, *events: tuple[Any, Any]) -> MuxOutput:
        """Updates at 50 Hz, each after `events`."""
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            for event in events:
                self.apply(event)
            output = self.check(PERIOD)
        return output


@given(EVENTS, st.sampled_from(["silence", "lock", "stance"]))
@settings(max_examples=100)
def test_whatever_happens_the_command_is_bounded_and_can_be_stopped(events: list[Any], stop: str) -> None:
    reference = ReferenceMux()
    for wait, event in events:
        reference.now += wait
        reference.apply(event)
        reference.check(wait)
    ramp = max(np.divide(BRISK.max_velocity, BRISK.stop_acceleration))
    if stop == "silence":
        output = reference.pass_time(TELEOP.timeout + ramp + 2 * PERIOD)
    else:
        reference.apply((stop, True))
        output = reference.pass_time(ramp + 2 * PERIOD, (TELEOP, (1.0, -1.0, 1.0)))
    assert (output.stance, output.source) == (True, "none")
    assert not output.velocity.any()


@given(EVENTS, st.tuples(*[st.floats(-10.0, 10.0)] * 3))
@settings(max_examples=50)
def test_whatever_happened_the_highest_priority_is_followed_once_nothing_stops_it(
    events: list[Any], velocity: tuple[float, ...]
) -> None:
    reference = ReferenceMux()
    for wait, event in events:
        reference.now += wait
        reference.apply(event)
        reference.check(wait)
    reference.mux.locks.clear()
    reference.mux.stance_requested = False
    output = reference.pass_time(4.0, (TELEOP, velocity), (PLANNER, (1.0, 0.0, 0.0)))
    followed = np.clip(velocity, np.negative(BRISK.max_velocity), BRISK.max_velocity)
    expected = followed if (np.abs(velocity) >= BRISK.dead_zone).any() else np.zeros(3)
    np.testing.assert_allclose(output.velocity, expected)
    assert output.stance == (not expected.any())
