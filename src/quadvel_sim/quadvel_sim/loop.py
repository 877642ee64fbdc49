"""A `Simulator` that runs by itself, as the robot does: in real time, in lockstep with a controller, or fast.

Commands come in from any thread (`submit`), samples of the state go out through a callback every `period` ms.
No ROS: `sim_node` puts topics around it.

In real time the loop wakes once a period, at absolute deadlines, and then simulates the period that has just
passed. A command takes effect at the simulated millisecond that follows its arrival: the robot behaves as if
the loop woke every millisecond. What is late is caught up; beyond MAX_LAG it is given up, and counted: a stall of
the machine stops the controller, too, and is no event in the robot's world. Nor is a controller that gets no time on a
loaded machine: the simulation runs at most LEAD ahead of what its commands answer, and waits for it before that.

While its time stands still, be it paused or waiting for an answer, it says so every WAITING_PERIOD: so a robot that waits
differs from one that has died.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping

import attrs
from numpy.typing import ArrayLike

from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand, RobotState
from quadvel_sim.simulator import DT, Simulator

REALTIME, LOCKSTEP, FAST = MODES = ("realtime", "lockstep", "fast")
MAX_LAG = 0.01  # s
LEAD = 10
"""ms that real time runs ahead of the newest state that was answered: half of the time after which the drives brake"""
WAITING_PERIOD = 0.02  # s, less than half of the silence after which a controller gives a robot up
MAX_AGE = 100  # ms, of the state that a command answers
_BREATH = 1e-4  # s that the fast mode leaves to other threads each period
_WRAP = 2**32

Publish = Callable[[RobotState, float], None]
"""Takes a sample, and the instant (s) at which it held."""
SayWaiting = Callable[[int, float], None]
"""Takes the tick at which time stands still, and the instant (s) at which it does"""


@attrs.frozen
class LoopReport:
    """How the loop did since the report before, and what it counted since the start."""

    realtime_factor: float
    worst_lateness: float  # s, of waking up
    given_up: float  # s of real time that were not simulated, since the start
    unanswered: int  # times that lockstep waited in vain, since the start
    braking: bool  # now
    fallen: bool  # now
    touched: Mapping[str, int]  # since the reset, as `Simulator.touched`


class SimulationLoop:
    """Runs `simulator`; all methods may be called from any thread.

    `publish(state, instant)` is called with the lock held, so that samples leave in order. `state.tick` and
    `state.time` go on over resets. `instant` (s) is when the sample holds: on `clock` in real time, else in
    simulated time. answer_timeout: s that simulated time stands still for an answer; then lockstep publishes the state again,
    and real time goes on without a controller until the next command. `say_waiting` is called while time stands still.
    """

    def __init__(
        self,
        simulator: Simulator,
        publish: Publish,
        mode: str = REALTIME,
        period: int = 5,
        answer_timeout: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
        say_waiting: SayWaiting = lambda tick, instant: None,
    ) -> None:
        self.simulator = simulator
        self.mode = mode
        self.period = period
        self._publish, self._say_waiting = publish, say_waiting
        self._answer_timeout = answer_timeout
        self._clock = clock
        self._condition = threading.Condition()
        self._inbox: deque[tuple[float, JointCommand]] = deque()
        self._before_reset = 0  # tick of the last reset
        self._answered = self._paused = self._stopped = False
        self._answered_tick: int | None = (
            None  # the newest that a command answered; None: nobody controls the robot
        )
        self._waits_since: float | None = None  # on the clock, for an answer, in real time
        self._stood_still = 0.0  # s, for an answer, in lockstep
        self._owed = 0  # ms that a paused simulation was asked for and has not simulated yet
        self._given_up = 0.0
        self._unanswered = 0
        self._anchor()
        self._begin_report()

    @property
    def tick(self) -> int:
        """Simulated ms since the start, resets included, without wrapping."""
        return self._before_reset + self.simulator.steps

    @property
    def paused(self) -> bool:
        """Whether time stands still."""
        return self._paused

    def run(self) -> None:
        """Run until `stop`. The simulator's FloatingPointError comes out here."""
        with self._condition:
            self._anchor()
            self._sample()
            while not self._stopped:
                if self._ready():
                    self.advance()

    def stop(self) -> None:
        """End `run`."""
        with self._condition:
            self._stopped = True
            self._condition.notify_all()

    def advance(self) -> None:
        """Simulate one period, or what is left of the steps of a paused simulation, and publish the state at its end."""
        with self._condition:
            self._answered = False
            steps = self._ahead
            self._step(steps)
            if self._paused:
                self._owed -= steps
            self._sample()

    def submit(self, command: JointCommand) -> None:
        """Give a command that arrives now. ValueError says why it is refused."""
        arrival = self._clock()
        with self._condition:
            self._check(command)
            if self._halted:  # all that comes now takes effect at the same instant: the newest counts
                self._inbox.clear()
            self._inbox.append((arrival, command))
            self._answered_tick = max(self._answered_tick or 0, self.tick - self._age(command))
            if self.mode == LOCKSTEP:
                self._answered = True
            if self.mode == LOCKSTEP or self._waits_since is not None:
                self._condition.notify_all()

    def reset(self, keyframe: str, simulator: Simulator | None = None) -> None:
        """Put the robot back, which takes a period, in another `simulator` if one is given; time goes on.

        ValueError where `keyframe` is unknown.
        """
        with self._condition:
            after, simulator = self.tick + self.period, simulator or self.simulator
            simulator.reset(keyframe)
            self.simulator, self._before_reset = simulator, after
            self._anchor()
            self._inbox.clear()
            self._answered, self._answered_tick = False, None
            self._sample()
            self._condition.notify_all()

    def pause(self, paused: bool) -> None:
        """Let time stand still, or go on."""
        with self._condition:
            self._paused, self._owed = paused, 0
            self._anchor()
            self._begin_report()
            self._condition.notify_all()

    def step(self, steps: int) -> None:
        """Let a paused simulation run on for `steps` ms, at its usual pace. ValueError where it is not paused."""
        with self._condition:
            if not self._paused:
                raise ValueError("the simulation runs; pause it first")
            if not self._owed:
                self._anchor()
            self._owed += steps
            self._condition.notify_all()

    def push(self, body: str, force: ArrayLike, torque: ArrayLike, duration: float) -> None:
        """As `Simulator.push`."""
        with self._condition:
            self.simulator.push(body, force, torque, duration)

    def report(self) -> LoopReport:
        """What happened since the last report."""
        with self._condition:
            elapsed = max(self._clock() - self._report_time, 1e-9)
            report = LoopReport(
                realtime_factor=(self.tick - self._report_tick) * DT / elapsed,
                worst_lateness=self._worst_lateness,
                given_up=self._given_up,
                unanswered=self._unanswered,
                braking=self.simulator.braking,
                fallen=self.simulator.fallen,
                touched=dict(self.simulator.touched),
            )
            self._begin_report()
            return report

    @property
    def _ahead(self) -> int:
        """How many ms come next: a period, or what is left to a paused simulation."""
        return min(self.period, self._owed) if self._paused else self.period

    @property
    def _halted(self) -> bool:
        return self._ahead == 0

    def _begin_report(self) -> None:
        self._report_time, self._report_tick, self._worst_lateness = self._clock(), self.tick, 0.0

    def _anchor(self) -> None:
        """Tie the present simulated time to the present real time."""
        self._anchor_time, self._anchor_tick = self._clock(), self.tick

    def _real_time(self, tick: int) -> float:
        """When `tick` is due on the clock, s."""
        return self._anchor_time + (tick - self._anchor_tick) * DT

    def _ready(self) -> bool:
        """Whether the next period may be simulated; if not, waits a while or until something happens."""
        if self._halted:
            self._stand_still(WAITING_PERIOD)
            return False
        if self.mode == FAST:
            self._condition.wait(_BREATH)
            return not (self._halted or self._stopped)
        if self.mode == LOCKSTEP:
            if not self._answered:
                self._wait_for_answer()
            return self._answered and not (self._halted or self._stopped)
        lateness = self._clock() - self._real_time(self.tick + self._ahead)
        if lateness < 0.0:
            self._condition.wait(-lateness)
            return False
        if self._waits():
            return False
        self._worst_lateness = max(self._worst_lateness, lateness)
        if lateness > MAX_LAG:
            self._given_up += lateness
            self._anchor_time += lateness
        return True

    def _waits(self) -> bool:
        """Whether real time stands still for the answer of a controller that is late; if so, waits for it a while."""
        if self._answered_tick is None or self.tick - self._answered_tick < LEAD:
            self._waits_since = None
            return False
        now = self._clock()
        if self._waits_since is None:
            self._waits_since = now
        left = self._waits_since + self._answer_timeout - now
        if left > 0.0:
            self._stand_still(min(left, WAITING_PERIOD))
            return True
        self._unanswered += 1
        self._answered_tick = self._waits_since = None
        return False

    def _wait_for_answer(self) -> None:
        """Wait a while in lockstep, and publish the state again where its answer has been missing for `answer_timeout`."""
        seconds = min(WAITING_PERIOD, self._answer_timeout)
        self._stood_still = self._stood_still + seconds if self._stand_still(seconds) else 0.0
        if self._stood_still >= self._answer_timeout:
            self._unanswered, self._stood_still = self._unanswered + 1, 0.0
            self._sample()  # for a controller that has come late

    def _stand_still(self, seconds: float) -> bool:
        """Wait for something to happen; whether nothing did within `seconds`."""
        if self._condition.wait(seconds):
            return False
        self._say_waiting(self.tick % _WRAP, self._clock() if self.mode == REALTIME else self.tick * DT)
        return True

    def _step(self, steps: int) -> None:
        """Simulate `steps` ms; each command takes effect when it is due."""
        while steps > 0:
            chunk = self._deliver(steps)
            self.simulator.step(chunk)
            steps -= chunk

    def _deliver(self, steps: int) -> int:
        """Hand over the commands that are due; how many ms, `steps` at most, lie before the next one."""
        while self._inbox:
            arrival, command = self._inbox[0]
            due = self._anchor_tick + math.ceil((arrival - self._anchor_time) / DT)
            if self.mode == REALTIME and due > self.tick:
                return min(steps, due - self.tick)
            self._inbox.popleft()
            self.simulator.command(command)
        return steps

    def _sample(self) -> None:
        state = self.simulator.state()
        state.tick = self.tick % _WRAP
        state.time = self.tick * DT
        self._publish(state, self._real_time(self.tick) if self.mode == REALTIME else state.time)

    def _check(self, command: JointCommand) -> None:
        if command.mode not in (MODE_DAMPING, MODE_SERVO):
            raise ValueError(f"mode is {command.mode}, expected {MODE_DAMPING} or {MODE_SERVO}")
        age = self._age(command)
        if self.mode == LOCKSTEP and age != 0:
            raise ValueError(f"it answers tick {command.tick}, expected {self.tick % _WRAP}")
        if age < 0:
            raise ValueError(f"it answers tick {command.tick}, which is to come: now is {self.tick % _WRAP}")
        if age > min(MAX_AGE, self.tick - self._before_reset):
            expected = f"expected at most {MAX_AGE} ms, and none from before a reset"
            raise ValueError(f"it answers tick {command.tick}, {age} ms ago: {expected}")

    def _age(self, command: JointCommand) -> int:
        """How long ago the state was that a command answers, ms; below zero for one that is to come."""
        return (self.tick - command.tick + _WRAP // 2) % _WRAP - _WRAP // 2
