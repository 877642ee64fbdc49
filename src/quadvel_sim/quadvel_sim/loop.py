"""Loop that runs a `Simulator` in real time, in lockstep with a controller, or fast. No ROS.

Commands arrive from any thread through `submit`, or are fetched by the loop once per period
(`receive`). States leave through a callback every `period` ms.

Real time: the loop wakes once per period at an absolute deadline and simulates the period that has
just passed. A command takes effect at the simulated millisecond that follows its arrival, as if the
loop woke every millisecond. Lateness is caught up. Lateness beyond `MAX_LAG_S` is skipped and
counted, because a stall of the machine stops the controller too. The simulation runs at most
`MAX_LEAD_MS` ahead of the newest answered state and then waits for the controller.

Waiting: while time stands still (paused, or waiting for an answer), the loop reports it every
`WAITING_PERIOD_S`. So a waiting robot can be distinguished from a dead one.
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
MAX_LAG_S = 0.01
"""Lateness in s beyond which real time is skipped instead of caught up."""
MAX_LEAD_MS = 10
"""Largest lead in ms of real time over the newest answered state: half of the drives' watchdog."""
WAITING_PERIOD_S = 0.02
"""Period in s of reports while time stands still: less than half of the controller's timeout."""
MAX_COMMAND_AGE_MS = 100
"""Largest age in ms of the state that a command answers."""
_YIELD_S = 1e-4  # pause for other threads in each period of the fast mode
_TICK_MODULUS = 2**32

PublishState = Callable[[RobotState, float], None]
"""Receives a state and its time in s."""
ReportWaiting = Callable[[int, float], None]
"""Receives the tick at which simulated time stands still, and the present time in s."""
FetchCommand = Callable[[], "JointCommand | None"]
"""Returns the newest command since the last call; None if there is none."""


@attrs.frozen
class LoopReport:
    """Statistics of the loop.

    Attributes:
        realtime_factor: Simulated time by elapsed time since the previous report.
        worst_lateness: Largest lateness of a wake-up since the previous report, s.
        given_up: Real time since the start that was not simulated, s.
        unanswered: Number of answer timeouts since the start.
        braking: Whether the drives brake now because no command arrives.
        fallen: Whether the robot lies on the ground or tilts too far now.
        touch_counts: Number of touches since the reset, by object name.
    """

    realtime_factor: float
    worst_lateness: float
    given_up: float
    unanswered: int
    braking: bool
    fallen: bool
    touch_counts: Mapping[str, int]


class SimulationLoop:
    """Runs a simulator in one thread; all methods may be called from any thread.

    Attributes:
        simulator: The simulated robot; replaced by `reset` if a new one is passed.
        mode: `realtime`, `lockstep` or `fast`.
        period: Simulated time between two published states, ms.
        receive: Called in the thread of `run` before each period is simulated, and during a pause.
            The command that it returns takes effect at the end of the period.
    """

    def __init__(
        self,
        simulator: Simulator,
        publish: PublishState,
        mode: str = REALTIME,
        period: int = 5,
        answer_timeout: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
        report_waiting: ReportWaiting = lambda tick, instant: None,
    ) -> None:
        """Prepare the loop; `run` starts it.

        Args:
            simulator: The simulated robot.
            publish: Called with a state and its time in s. Time is `clock` in real time, else
                simulated time. The lock is held, so states leave in order; `tick` and `time`
                increase over resets.
            mode: `realtime`, `lockstep` or `fast`.
            period: Simulated time between two published states, ms.
            answer_timeout: Time that the simulation waits for an answer, s. After it, lockstep
                publishes the state again; real time continues without a controller until the next
                command.
            clock: Returns the present time in s; must not be set back.
            report_waiting: Called with tick and time in s while simulated time stands still.
        """
        self.simulator = simulator
        self.mode = mode
        self.period = period
        self.receive: FetchCommand = lambda: None
        self._publish, self._report_waiting = publish, report_waiting
        self._answer_timeout = answer_timeout
        self._clock = clock
        self._condition = threading.Condition()
        self._inbox: deque[tuple[float, JointCommand]] = deque()
        self._reset_tick = 0  # tick of the last reset
        self._answered = self._paused = self._stopped = False
        self._answered_tick: int | None = None  # newest answered tick; None: no controller
        self._waiting_since: float | None = None  # on the clock, for an answer, in real time
        self._waited = 0.0  # s, for an answer, in lockstep
        self._requested_steps = 0  # ms that a paused simulation still has to advance
        self._given_up = 0.0
        self._unanswered = 0
        self._anchor_clock()
        self._begin_report()

    @property
    def tick(self) -> int:
        """Simulated time since the start in ms; resets included, not wrapped."""
        return self._reset_tick + self.simulator.steps

    @property
    def paused(self) -> bool:
        """Whether the simulation is paused."""
        return self._paused

    def run(self) -> None:
        """Run until `stop` is called; the simulator's FloatingPointError propagates."""
        with self._condition:
            self._anchor_clock()
            self._publish_state()
            while not self._stopped:
                if self._wait_until_ready():
                    self.advance()
                elif self._is_halted:
                    self._receive_command()

    def stop(self) -> None:
        """Make `run` return."""
        with self._condition:
            self._stopped = True
            self._condition.notify_all()

    def advance(self) -> None:
        """Simulate one period (or the steps left to a paused simulation) and publish the state."""
        with self._condition:
            self._receive_command()
            self._answered = False
            steps = self._next_steps
            self._simulate(steps)
            if self._paused:
                self._requested_steps -= steps
            self._publish_state()

    def submit(self, command: JointCommand) -> None:
        """Accept a command that arrives now.

        Args:
            command: Joint command; its tick names the state that it answers.

        Raises:
            ValueError: The mode is unknown, or the answered tick is in the future or too old.
        """
        arrival = self._clock()
        with self._condition:
            self._accept(command, arrival)

    def reset(self, keyframe: str, simulator: Simulator | None = None) -> None:
        """Reset the robot; this takes one period of simulated time, and time continues.

        Args:
            keyframe: Posture, `lie` or `stand`.
            simulator: Replacement of the simulator, for another terrain; None keeps it.

        Raises:
            ValueError: The keyframe is unknown.
        """
        with self._condition:
            after, simulator = self.tick + self.period, simulator or self.simulator
            simulator.reset(keyframe)
            self.simulator, self._reset_tick = simulator, after
            self._anchor_clock()
            self._inbox.clear()
            self._answered, self._answered_tick = False, None
            self._publish_state()
            self._condition.notify_all()

    def pause(self, paused: bool) -> None:
        """Pause or resume the simulation.

        Args:
            paused: True to pause, False to resume.
        """
        with self._condition:
            self._paused, self._requested_steps = paused, 0
            self._anchor_clock()
            self._begin_report()
            self._condition.notify_all()

    def step(self, steps: int) -> None:
        """Advance a paused simulation at its usual pace.

        Args:
            steps: Simulated time, ms.

        Raises:
            ValueError: The simulation is not paused.
        """
        with self._condition:
            if not self._paused:
                raise ValueError("the simulation runs; pause it first")
            if not self._requested_steps:
                self._anchor_clock()
            self._requested_steps += steps
            self._condition.notify_all()

    def push(self, body: str, force: ArrayLike, torque: ArrayLike, duration: float) -> None:
        """Push a body of the robot, see `Simulator.push`.

        Args:
            body: Name of the body.
            force: Force at the centre of mass, (3,), N, world frame.
            torque: Torque, (3,), N m, world frame.
            duration: Duration, s.
        """
        with self._condition:
            self.simulator.push(body, force, torque, duration)

    def report(self) -> LoopReport:
        """Return the statistics and start the next interval.

        Returns:
            Statistics since the previous report.
        """
        with self._condition:
            elapsed = max(self._clock() - self._report_time, 1e-9)
            report = LoopReport(
                realtime_factor=(self.tick - self._report_tick) * DT / elapsed,
                worst_lateness=self._worst_lateness,
                given_up=self._given_up,
                unanswered=self._unanswered,
                braking=self.simulator.braking,
                fallen=self.simulator.fallen,
                touch_counts=dict(self.simulator.touch_counts),
            )
            self._begin_report()
            return report

    @property
    def _next_steps(self) -> int:
        """Number of ms of the next period; a paused simulation may have fewer or none."""
        return min(self.period, self._requested_steps) if self._paused else self.period

    @property
    def _is_halted(self) -> bool:
        return self._next_steps == 0

    def _begin_report(self) -> None:
        self._report_time, self._report_tick, self._worst_lateness = self._clock(), self.tick, 0.0

    def _anchor_clock(self) -> None:
        """Tie the present simulated time to the present real time."""
        self._anchor_time, self._anchor_tick = self._clock(), self.tick

    def _real_time(self, tick: int) -> float:
        """Return the clock time at which `tick` is due, s."""
        return self._anchor_time + (tick - self._anchor_tick) * DT

    def _receive_command(self) -> None:
        """Fetch a command; it arrived before the end of the period that is simulated next."""
        command = self.receive()
        if command is not None:
            end = self._real_time(self.tick + self._next_steps)
            self._accept(command, min(self._clock(), end - 0.5 * DT))

    def _accept(self, command: JointCommand, arrival: float) -> None:
        """Queue a command that arrived at `arrival` (s); raise ValueError if it is invalid."""
        self._check_command(command)
        if self._is_halted:  # all commands of a halt take effect at one instant: the newest counts
            self._inbox.clear()
        self._inbox.append((arrival, command))
        self._answered_tick = max(self._answered_tick or 0, self.tick - self._command_age(command))
        if self.mode == LOCKSTEP:
            self._answered = True
        if self.mode == LOCKSTEP or self._waiting_since is not None:
            self._condition.notify_all()

    def _wait_until_ready(self) -> bool:
        """Return whether the next period may be simulated; if not, wait for a while first."""
        if self._is_halted:
            self._wait_and_report(WAITING_PERIOD_S)
            return False
        if self.mode == FAST:
            self._condition.wait(_YIELD_S)
            return not (self._is_halted or self._stopped)
        if self.mode == LOCKSTEP:
            if not self._answered:
                self._wait_for_answer()
            return self._answered and not (self._is_halted or self._stopped)
        lateness = self._clock() - self._real_time(self.tick + self._next_steps)
        if lateness < 0.0:
            self._condition.wait(-lateness)
            return False
        if self._wait_for_late_controller():
            return False
        self._worst_lateness = max(self._worst_lateness, lateness)
        if lateness > MAX_LAG_S:
            self._given_up += lateness
            self._anchor_time += lateness
        return True

    def _wait_for_late_controller(self) -> bool:
        """Return whether real time must wait for the controller; if so, wait for a while first."""
        if self._answered_tick is None or self.tick - self._answered_tick < MAX_LEAD_MS:
            self._waiting_since = None
            return False
        now = self._clock()
        if self._waiting_since is None:
            self._waiting_since = now
        left = self._waiting_since + self._answer_timeout - now
        if left > 0.0:
            self._wait_and_report(min(left, WAITING_PERIOD_S))
            return True
        self._unanswered += 1
        self._answered_tick = self._waiting_since = None
        return False

    def _wait_for_answer(self) -> None:
        """Wait for an answer in lockstep; publish the state again after `answer_timeout`."""
        seconds = min(WAITING_PERIOD_S, self._answer_timeout)
        self._waited = self._waited + seconds if self._wait_and_report(seconds) else 0.0
        if self._waited >= self._answer_timeout:
            self._unanswered, self._waited = self._unanswered + 1, 0.0
            self._publish_state()  # for a controller that started later

    def _wait_and_report(self, seconds: float) -> bool:
        """Wait for an event; after `seconds` without one, report the wait and return True."""
        if self._condition.wait(seconds):
            return False
        self._report_waiting(
            self.tick % _TICK_MODULUS, self._clock() if self.mode == REALTIME else self.tick * DT
        )
        return True

    def _simulate(self, steps: int) -> None:
        """Simulate `steps` ms; each command takes effect when it is due."""
        while steps > 0:
            chunk = self._apply_due_commands(steps)
            self.simulator.step(chunk)
            steps -= chunk

    def _apply_due_commands(self, steps: int) -> int:
        """Apply due commands; return the ms, at most `steps`, until the next one is due."""
        while self._inbox:
            arrival, command = self._inbox[0]
            due = self._anchor_tick + math.ceil((arrival - self._anchor_time) / DT)
            if self.mode == REALTIME and due > self.tick:
                return min(steps, due - self.tick)
            self._inbox.popleft()
            self.simulator.command(command)
        return steps

    def _publish_state(self) -> None:
        """Publish the present state with ticks that increase over resets."""
        state = self.simulator.state()
        state.tick = self.tick % _TICK_MODULUS
        state.time = self.tick * DT
        self._publish(state, self._real_time(self.tick) if self.mode == REALTIME else state.time)

    def _check_command(self, command: JointCommand) -> None:
        """Refuse a command with an unknown mode or an impossible tick."""
        if command.mode not in (MODE_DAMPING, MODE_SERVO):
            raise ValueError(f"mode is {command.mode}, expected {MODE_DAMPING} or {MODE_SERVO}")
        age = self._command_age(command)
        if self.mode == LOCKSTEP and age != 0:
            raise ValueError(f"it answers tick {command.tick}, expected {self.tick % _TICK_MODULUS}")
        if age < 0:
            raise ValueError(
                f"it answers tick {command.tick}, which is to come: now is {self.tick % _TICK_MODULUS}"
            )
        if age > min(MAX_COMMAND_AGE_MS, self.tick - self._reset_tick):
            expected = f"expected at most {MAX_COMMAND_AGE_MS} ms, and none from before a reset"
            raise ValueError(f"it answers tick {command.tick}, {age} ms ago: {expected}")

    def _command_age(self, command: JointCommand) -> int:
        """Return the age in ms of the answered state; negative if it lies in the future."""
        return (self.tick - command.tick + _TICK_MODULUS // 2) % _TICK_MODULUS - _TICK_MODULUS // 2
