"""Tests of simulated time: real time, answers and requests; commands take effect when due."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from quadvel_actuator import ActuatorParameters
from quadvel_description.state import MODE_SERVO, JointCommand, RobotState
from quadvel_sim.config import SensorNoise, SimulatorConfig
from quadvel_sim.loop import SimulationLoop
from quadvel_sim.simulator import Simulator
from tests.helpers.robots import ALIENGO


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Bench:
    """A loop with a clock of the test's own, and what it published."""

    def __init__(self, mode: str, period: int = 5, **fields: object) -> None:
        config = SimulatorConfig(
            robot=ALIENGO, noise=SensorNoise.none(), actuator=ActuatorParameters.ideal(ALIENGO), armature=1e9
        )
        self.clock = Clock()
        self.samples: list[tuple[RobotState, float]] = []
        self.waiting: list[tuple[int, float]] = []
        fields = {"clock": self.clock, "report_waiting": lambda *words: self.waiting.append(words), **fields}
        self.loop = SimulationLoop(Simulator(config), self.note, mode, period, **fields)

    def note(self, state: RobotState, instant: float) -> None:
        self.samples.append((state, instant))

    def torque(self) -> float:
        return float(self.samples[-1][0].tau[0])


def command(torque: float, tick: int, mode: int = MODE_SERVO) -> JointCommand:
    return JointCommand(q=ALIENGO.lie_q, tau=np.full(12, torque), tick=tick, mode=mode)


def wait_for(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.002)


@contextmanager
def running(loop: SimulationLoop) -> Iterator[None]:
    thread = threading.Thread(target=loop.run)
    thread.start()
    try:
        yield
    finally:
        loop.stop()
        thread.join(10.0)
        assert not thread.is_alive()


def test_a_command_takes_effect_at_the_millisecond_after_its_arrival() -> None:
    bench = Bench("realtime", period=1)
    torques = []
    for tick in range(12):
        for torque, arrival in ((2.0, 0.0032), (3.0, 0.0080)):
            if arrival < 0.001 * (tick + 1) <= arrival + 0.001:
                bench.clock.now = 100.0 + arrival
                bench.loop.submit(command(torque, 0))
        bench.loop.advance()
        torques.append(bench.torque())
    # It came after 3 ms and counts from 4 ms on; the sample of that instant is the last with the old torque.
    assert torques == pytest.approx([0.0] * 4 + [2.0] * 4 + [3.0] * 4, abs=1e-9)


def test_real_time_waits_for_a_controller_that_is_late() -> None:
    bench = Bench("realtime", clock=time.monotonic, answer_timeout=5.0)
    with running(bench.loop):
        for _ in range(20):
            tick = bench.loop.tick
            bench.loop.submit(command(1.0, tick))
            wait_for(lambda: bench.loop.tick > tick)  # noqa: B023
        time.sleep(0.3)  # it gets no time
        stopped = bench.loop.tick
        assert tick + 10 <= stopped <= tick + 15
        assert bench.loop.report().braking is False
        bench.loop.submit(command(1.0, stopped))
        wait_for(lambda: bench.loop.tick > stopped)
        assert bench.loop.report().given_up > 0.2


def test_real_time_waits_for_no_controller_that_has_gone() -> None:
    bench = Bench("realtime", clock=time.monotonic, answer_timeout=0.1)
    with running(bench.loop):
        bench.loop.submit(command(1.0, 0))
        wait_for(lambda: bench.loop.tick > 100)
        report = bench.loop.report()
    assert report.braking
    assert report.unanswered == 1
    assert report.given_up == pytest.approx(0.1, abs=0.09)


def test_that_millisecond_is_the_same_however_rarely_the_loop_wakes() -> None:
    positions = []
    for period in (1, 5, 20):
        bench = Bench("realtime", period=period)
        bench.loop.simulator.actuator.reset()
        bench.clock.now = 100.0
        for k in range(40):
            bench.clock.now = 100.0 + 0.001 * k + 0.0004
            if k in (3, 11, 24):
                bench.loop.submit(command(1.0 + k, 0))
            if (k + 1) % period == 0:
                bench.loop.advance()
        positions.append(bench.loop.simulator.data.qvel.copy())
    np.testing.assert_array_equal(positions[0], positions[1])
    np.testing.assert_array_equal(positions[0], positions[2])
    assert positions[0].any()


def test_samples_tell_the_real_time_at_which_they_hold_without_drift() -> None:
    bench = Bench("realtime")
    for k in range(100):
        bench.clock.now = 100.0 + 0.005 * (k + 1) + 0.0007 * (k % 3)  # wakes late, by another time each time
        bench.loop.advance()
    np.testing.assert_allclose([instant for _, instant in bench.samples], 100.0 + 0.005 * np.arange(1, 101))
    assert [state.tick for state, _ in bench.samples] == [5 * k for k in range(1, 101)]


def test_realtime_keeps_pace_with_the_clock() -> None:
    samples: list[tuple[float, float, float]] = []

    def note(state: RobotState, instant: float) -> None:
        samples.append((state.time, instant, time.monotonic() - instant))

    loop = SimulationLoop(Simulator(SimulatorConfig(robot=ALIENGO)), note)
    with running(loop):
        wait_for(lambda: len(samples) > 60)
    simulated, instants, late = np.array(samples).T
    np.testing.assert_allclose(np.diff(simulated), 0.005)
    assert late.min() >= 0.0  # never published before it holds
    assert np.ptp(instants) == pytest.approx(np.ptp(simulated) + loop.report().given_up)


@pytest.mark.parametrize("stall", [0.03, 2.0])
def test_a_stall_of_the_machine_is_no_event_in_the_robots_world(stall: float) -> None:
    bench = Bench("realtime")
    with running(bench.loop):
        wait_for(lambda: len(bench.samples) == 1)
        bench.clock.now += stall
        wait_for(lambda: len(bench.samples) == 2)
    assert bench.samples[-1][0].time == pytest.approx(0.005)  # one period on, not what the stall lasted
    assert bench.samples[-1][1] == pytest.approx(100.0 + stall)  # and as new as any other
    assert bench.loop.report().given_up == pytest.approx(stall, abs=0.01)


def test_lockstep_waits_for_the_command_that_answers_its_tick() -> None:
    bench = Bench("lockstep")
    with running(bench.loop):
        for k in range(20):
            wait_for(lambda: len(bench.samples) == k + 1)  # noqa: B023
            state, instant = bench.samples[-1]
            assert (state.tick, instant) == (5 * k, pytest.approx(0.005 * k))
            if k == 7:
                with pytest.raises(ValueError, match="it answers tick 30, expected 35"):
                    bench.loop.submit(command(0.0, 30))
                time.sleep(0.02)
                assert len(bench.samples) == k + 1
            bench.loop.submit(command(float(k), state.tick))
        wait_for(lambda: len(bench.samples) == 21)
    assert bench.torque() == 19.0


def test_lockstep_without_answer_stands_still_and_sends_its_state_again() -> None:
    bench = Bench("lockstep", answer_timeout=0.01)
    with running(bench.loop):
        wait_for(lambda: bench.loop.report().unanswered >= 3)
        assert {state.tick for state, _ in bench.samples} == {0}
        bench.loop.submit(command(0.0, 0))
        wait_for(lambda: bench.samples[-1][0].tick == 5)


def test_a_robot_whose_time_stands_still_says_so() -> None:
    """Otherwise a waiting robot looks like a dead one."""
    bench = Bench("realtime", clock=time.monotonic, answer_timeout=5.0)
    with running(bench.loop):
        bench.loop.submit(command(1.0, 0))
        wait_for(lambda: len(bench.waiting) > 3)  # for the answer to the newest state
        newest = bench.samples[-1][0].tick
        bench.loop.submit(command(1.0, newest))
        wait_for(lambda: bench.samples[-1][0].tick > newest)
        ticks, instants = np.array(bench.waiting).T
        np.testing.assert_array_equal(ticks, newest)
        assert np.diff(instants).min() > 0.0
        assert instants[-1] <= bench.samples[-1][1]  # no state that follows is older


@pytest.mark.parametrize("mode", ["realtime", "lockstep", "fast"])
def test_a_paused_robot_says_in_each_mode_that_its_time_stands_still(mode: str) -> None:
    bench = Bench(mode)
    with running(bench.loop):
        bench.loop.pause(True)
        bench.waiting.clear()
        wait_for(lambda: len(bench.waiting) > 2)
        assert {tick for tick, _ in bench.waiting} == {bench.loop.tick}


def test_fast_goes_on_by_itself_and_takes_commands() -> None:
    bench = Bench("fast")
    with running(bench.loop):
        wait_for(lambda: len(bench.samples) > 50)
        bench.loop.pause(True)
        bench.loop.submit(command(4.0, bench.samples[-1][0].tick))
        bench.loop.step(10)
        wait_for(lambda: bench.torque() == 4.0)
    assert bench.clock.now == 100.0


def test_a_pause_stops_time_and_steps_advance_it() -> None:
    bench = Bench("fast")
    with pytest.raises(ValueError, match="the simulation runs; pause it first"):
        bench.loop.step(5)
    with running(bench.loop):
        bench.loop.pause(True)
        tick = bench.loop.tick
        time.sleep(0.03)
        assert bench.loop.tick == tick
        count = len(bench.samples)
        bench.loop.step(7)
        wait_for(lambda: bench.samples[-1][0].tick == tick + 7)
        time.sleep(0.03)
        assert [state.tick for state, _ in bench.samples[count:]] == [tick + 5, tick + 7]
        bench.loop.pause(False)
        wait_for(lambda: bench.loop.tick > tick + 7)


def test_steps_in_lockstep_wait_for_the_answer_to_each_state() -> None:
    bench = Bench("lockstep", answer_timeout=10.0)
    with running(bench.loop):
        wait_for(lambda: len(bench.samples) == 1)
        bench.loop.pause(True)
        bench.loop.step(100)
        for tick in range(0, 100, 5):
            bench.loop.submit(command(2.0, tick))
            wait_for(lambda: bench.samples[-1][0].tick == tick + 5)  # noqa: B023
            assert not bench.loop.report().braking
        bench.loop.submit(command(2.0, 100))
        time.sleep(0.03)
        assert bench.samples[-1][0].tick == 100


def test_after_a_pause_realtime_does_not_catch_up() -> None:
    bench = Bench("realtime")
    with running(bench.loop):
        wait_for(lambda: len(bench.samples) == 1)
        bench.loop.pause(True)
        bench.clock.now += 60.0
        bench.loop.pause(False)
        bench.clock.now += 0.0051
        wait_for(lambda: len(bench.samples) == 2)
        time.sleep(0.02)
    assert len(bench.samples) == 2
    assert bench.samples[-1][1] == pytest.approx(160.005)
    assert bench.loop.report().given_up == 0.0


def test_samples_stay_in_order_of_time_however_one_steps_pauses_and_resets() -> None:
    bench = Bench("realtime")
    with running(bench.loop):
        for order, steps in (
            (lambda: bench.loop.step(500), 500),
            (lambda: bench.loop.reset("lie"), 5),
            (lambda: bench.loop.step(1), 1),
        ):
            bench.loop.pause(True)
            bench.clock.now += 0.003
            after = bench.loop.tick + steps
            order()
            while bench.loop.tick < after:
                bench.clock.now += 0.001
                time.sleep(0.001)
            bench.loop.pause(False)
            count = len(bench.samples)
            bench.clock.now += 0.0075
            wait_for(lambda: len(bench.samples) > count)  # noqa: B023
    ticks, instants = zip(*((state.tick, instant) for state, instant in bench.samples), strict=True)
    assert np.diff(ticks).min() > 0
    assert np.diff(instants).min() > 0.0
    assert max(instants) <= bench.clock.now


def test_a_reset_puts_the_robot_back_while_its_clock_goes_on() -> None:
    bench = Bench("realtime")
    bench.loop.submit(command(5.0, 0))
    for _ in range(3):
        bench.loop.advance()
    bench.clock.now = 100.016
    bench.loop.submit(command(9.0, 15))
    bench.loop.reset("stand")
    state, instant = bench.samples[-1]
    assert (state.tick, state.time, instant) == (20, 0.02, 100.016)  # later than the sample before
    np.testing.assert_array_equal(state.q, ALIENGO.nominal_q)
    bench.loop.advance()
    assert bench.loop.simulator.braking  # what came before the reset is forgotten
    assert bench.samples[-1][0].tick == 25
    assert bench.samples[-1][1] == pytest.approx(100.021)
    with pytest.raises(ValueError, match="it answers tick 15, 10 ms ago: expected at most 100 ms, and none"):
        bench.loop.submit(command(0.0, 15))


def test_lockstep_publishes_anew_after_a_reset() -> None:
    bench = Bench("lockstep")
    with running(bench.loop):
        wait_for(lambda: len(bench.samples) == 1)
        bench.loop.submit(command(0.0, 0))
        wait_for(lambda: len(bench.samples) == 2)
        bench.loop.reset("stand")
        assert bench.samples[-1][0].tick == 10
        bench.loop.submit(command(0.0, 10))
        wait_for(lambda: len(bench.samples) == 4)


@pytest.mark.parametrize(
    ("tick", "mode", "sentence"),
    [
        (301, MODE_SERVO, "it answers tick 301, which is to come: now is 300"),
        (199, MODE_SERVO, "it answers tick 199, 101 ms ago: expected at most 100 ms"),
        (300, 7, "mode is 7, expected 0 or 10"),
    ],
)
def test_a_command_that_cannot_be_an_answer_is_refused(tick: int, mode: int, sentence: str) -> None:
    bench = Bench("realtime")
    for _ in range(60):
        bench.loop.advance()
    with pytest.raises(ValueError, match=sentence):
        bench.loop.submit(command(0.0, tick, mode))
    bench.loop.submit(command(0.0, 200))


def test_a_diverged_simulation_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log where it stands
    bench = Bench("fast")
    bench.loop.simulator.data.qvel[0] = np.nan
    with pytest.raises(FloatingPointError):
        bench.loop.run()


def test_a_command_that_is_fetched_takes_effect_at_the_end_of_the_period() -> None:
    bench = Bench("realtime", period=1)
    commands = {3: 2.0, 8: 3.0}  # torque, N m, by the number of the period in which it arrives
    torques: list[float] = []

    def receive() -> JointCommand | None:
        torque = commands.get(bench.loop.tick)
        return None if torque is None else command(torque, bench.loop.tick)

    def note(state: RobotState, instant: float) -> None:
        torques.append(float(state.tau[0]))
        bench.clock.now = 100.0 + 1e-3 * (state.tick + 1) + 2e-4  # the next wake-up is late
        if state.tick == 12:
            bench.loop.stop()

    bench.loop._publish, bench.loop.receive = note, receive
    bench.loop.run()
    assert torques == pytest.approx([0.0] * 5 + [2.0] * 5 + [3.0] * 3, abs=1e-9)
