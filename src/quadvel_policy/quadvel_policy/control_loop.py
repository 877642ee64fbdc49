"""Timing of the controller: selects the states that start a tick, and its inputs. Knows no ROS.

Ticks are locked to the phase of the states: a tick runs when the state that is due arrives, so the
latency is small and constant. Due times lie on a grid in the time of the states (`TickGrid`), so
states may be faster than 200 Hz. The deadline of a tick is one period after the time of its state.
If states stop, `watch` runs the supervisor. With simulated time, the same holds in that time, and
the answer waits until estimator and mux have processed the state, so the simulator does not outrun
them.

All times are numbers in s. Except for the clock, they are stall-free times of the robot
(`StallFreeClock`): a stall of the machine together with its simulator is no gap.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.fields import positive
from quadvel_description.state import JointCommand, RobotState
from quadvel_nodes.messages import MessageError
from quadvel_nodes.stall_free_clock import StallFreeClock
from quadvel_nodes.tick_grid import TickGrid

from .config import SupervisorConfig
from .guard import FALL_TIME_S
from .loop_stats import LoopStats
from .observation import CONTROL_PERIOD_S
from .received import StampCheck
from .stall_detector import StallDetector
from .supervisor import Supervisor
from .tick_input import TickInput

WATCH_PERIOD_S = 0.02
"""s between two calls of `watch`."""
MAX_STALL_S = 0.5
"""s, longest stall of the whole machine that is excused, and longest wait of a simulated robot for
a node that lags. It is half of the time for which a simulator waits for its answer.
"""
LOCKSTEP_WAIT_S = 2.0
"""s of real time, longest wait of a robot in lockstep for a node that lags."""

MIN_CLOCK_STEP_S = 0.02
"""s, smallest step of the clock against the steady clock that counts as setting it; valid if both
clocks are read within half of this time.
"""

Stamped = tuple[float, Array]
"""Time (s) and value."""


@attrs.frozen(kw_only=True)
class ControlConfig:
    """Parameters of the supervisor, and age limits of its inputs; each is a node parameter."""

    supervisor: SupervisorConfig = SupervisorConfig()
    max_velocity_age: float = positive(
        0.05,
        "oldest velocity estimate that is used; after that the Kalman filter replaces it, s",
        at_most=FALL_TIME_S,
    )
    command_timeout: float = positive(
        0.5, "oldest command that is used; after that the robot stands, s", at_most=FALL_TIME_S
    )


@attrs.define
class _LaggingNode:
    """A node that a simulated robot waits for, so that it does not outrun it.

    After `max_wait`, the robot no longer waits until the node sends a message again.

    Attributes:
        max_lag: Largest accepted lag of the node's newest message behind the robot, s.
        max_wait: Longest wait of the robot, s.
    """

    max_lag: float
    max_wait: float
    _waiting_since: float | None = None

    def on_message(self) -> None:
        """Record that a message arrived."""
        self._waiting_since = None

    def delays_robot(self, age: float, now: float) -> bool:
        """Return whether the robot must wait for this node.

        Args:
            age: age of the newest message, s, stall-free.
            now: steady clock, s.
        """
        if age <= self.max_lag:
            return False
        if self._waiting_since is None:
            self._waiting_since = now
        return now - self._waiting_since <= self.max_wait


class ControlLoop:
    """Runs one supervisor at the right times.

    Attributes:
        supervisor: The supervisor.
        stats: Timing statistics.
        stall_detector: Detector of stalls of this process.
        inputs: Inputs of the newest tick; the caller sets `motors` and `duplicate_publisher`.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        config: ControlConfig,
        answer: Callable[[JointCommand], None],
        clock: Callable[[], float],
        sim_time: bool = False,
        steady: Callable[[], float] | None = None,
    ) -> None:
        """Create a loop.

        Args:
            supervisor: The supervisor.
            config: Parameters of the supervisor and age limits.
            answer: Called with each joint command.
            clock: Clock of the stamps, s.
            sim_time: Whether that clock is a simulator's in lockstep, which waits for the answer to
                each state.
            steady: Clock that is never set, s, by which steps of `clock` are detected; None if
                `clock` has none.
        """
        self.supervisor = supervisor
        self.stats = LoopStats()
        self.stall_detector = StallDetector(WATCH_PERIOD_S, CONTROL_PERIOD_S)
        self.inputs = TickInput()
        self._guards = config.supervisor.guards
        self._config, self._publish, self._sim_time = config, answer, sim_time
        self._clock, self._steady = clock, steady or clock
        self._clock_offset = self._clock() - self._steady()
        self._velocity_lead = (
            math.inf if self._guards.robot_waits else 0.0
        )  # s, by which a velocity may be ahead of the state during a stall
        self._robot_time, self._grid = StallFreeClock(), TickGrid(CONTROL_PERIOD_S)
        self._waiting_state: RobotState | None = None  # the state that waits for estimator or mux
        max_wait = LOCKSTEP_WAIT_S if sim_time else MAX_STALL_S
        self._estimator = _LaggingNode(1.5 * CONTROL_PERIOD_S, max_wait)
        self._mux = _LaggingNode(0.5 * config.command_timeout if sim_time else math.inf, max_wait)
        self._answer = JointCommand.damping()
        self._velocity: Stamped | None = None
        self._command: Stamped | None = None
        self._checks = {
            "low_state": StampCheck(self._guards.silence_limit),
            "waiting": StampCheck(self._guards.silence_limit),
            "velocity_estimate": StampCheck(config.max_velocity_age + self._velocity_lead),
            "command": StampCheck(config.command_timeout),
        }

    @property
    def stalled(self) -> float:
        """Time that the robot stood still together with the machine, since the start, s."""
        return self._robot_time.stalled

    def on_state(self, state: RobotState) -> None:
        """Receive a state; answer it if it is due.

        Args:
            state: The state; its `time` is its stamp, s.

        Raises:
            MessageError: The stamp is too old, in the future, or older than the one before.
        """
        start = time.perf_counter()
        now = self._accept("low_state", state.time)
        self.stall_detector.poll(now)
        longest = max(MAX_STALL_S if self.stall_detector.has_stalled else 0.0, self._guards.silence_limit)
        state.time = self._robot_time.update(state.time, state.tick, longest)
        self.inputs.stopped += self.stall_detector.stalled_s
        self.stall_detector.on_message()
        if self._outruns_others(state):
            self._waiting_state = state
        else:
            self._answer_if_due(state, now, start)

    def on_waiting(self, stamp: float, tick: int) -> None:
        """Receive the robot's report that its time stands still; an unknown tick is ignored.

        Args:
            stamp: Time of the report, s.
            tick: Tick at which the robot waits, ms.

        Raises:
            MessageError: The stamp is invalid.
        """
        now = self._accept("waiting", stamp)
        if self.inputs.state is not None and tick == self._robot_time.tick:
            self._robot_time.update(stamp, tick, is_waiting=True)
        self._resume(now)

    def on_velocity(self, stamp: float, velocity: Array) -> None:
        """Receive a velocity estimate.

        Args:
            stamp: Time of the estimate, s.
            velocity: Velocity of the trunk, body frame, (3,), m/s.

        Raises:
            MessageError: The stamp is invalid.
        """
        now = self._accept("velocity_estimate", stamp)
        self._velocity = self._robot_time.time_at(stamp), velocity
        self._estimator.on_message()
        self._resume(now)

    def on_command(self, stamp: float, velocity: ArrayLike, stance: bool) -> None:
        """Receive a velocity command.

        Args:
            stamp: Time of the command, s.
            velocity: vx, vy (m/s), wz (rad/s), (3,).
            stance: Whether the robot must stand.

        Raises:
            MessageError: The stamp is invalid.
        """
        now = self._accept("command", stamp)
        self._command = self._robot_time.time_at(stamp), np.append(velocity, float(stance))
        self._mux.on_message()
        self._resume(now)

    def refuse(self, topic: str, why: MessageError) -> None:
        """Record a refused message for the guards, until a valid one comes.

        A later refusal for age does not replace an earlier, more specific reason.

        Args:
            topic: Topic of the message.
            why: The reason.
        """
        if type(why) is not MessageError or topic not in self.inputs.refused:
            self.inputs.refused[topic] = why

    def watch(self) -> None:
        """Run the supervisor if no valid state comes; to be called every WATCH_PERIOD_S."""
        now = self._now()
        self.stall_detector.poll(now)
        state = self.inputs.state
        if state is None:
            return
        refused = "low_state" in self.inputs.refused
        limit = self._guards.max_state_age if refused else self._guards.silence_limit
        if now - self.stalled - state.time > limit and not self.stall_detector.excuses_silence(now):
            self._tick(state, now)

    def _now(self, stamp: float = 0.0) -> float:
        """Return the clock of the stamps, s, at least `stamp` in simulated time, which may arrive late."""
        before, now = self._steady(), self._clock()
        ahead = now - before
        if (
            abs(ahead - self._clock_offset) > MIN_CLOCK_STEP_S
            and self._steady() - before < 0.5 * MIN_CLOCK_STEP_S
        ):
            self._robot_time.on_clock_set(ahead - self._clock_offset)
            self._clock_offset = ahead
        return max(now, stamp) if self._sim_time else now

    def _accept(self, topic: str, stamp: float) -> float:
        now = self._now(stamp)
        self._checks[topic].check(stamp, now)
        self.inputs.refused.pop(topic, None)
        return now

    def _outruns_others(self, state: RobotState) -> bool:
        """Return whether the simulator must wait for the estimator, or in lockstep for the mux."""
        if not (self._sim_time or self._guards.robot_waits):
            return False
        now = time.monotonic()
        known = ((self._velocity, self._estimator), (self._command, self._mux))
        return any(last is not None and node.delays_robot(state.time - last[0], now) for last, node in known)

    def _answer_if_due(self, state: RobotState, now: float, start: float) -> None:
        """Run a tick if the state is due; `now` and `start`: begin of the work on the clock and the steady clock, s."""
        self._waiting_state = None
        periods = self._grid.periods_due(state.time)
        if periods:
            self._tick(state, now)
            compute = time.perf_counter() - start
            late = self._now() - self.stalled - state.time > CONTROL_PERIOD_S
            self.stats.add(start, compute, self.supervisor.inference_seconds, periods - 1 + late)
            self.supervisor.run_deferred()
        elif self._sim_time:  # a simulator in lockstep waits for the answer to each of its states
            self._answer.tick = state.tick
            self._publish(self._answer)

    def _tick(self, state: RobotState, now: float) -> None:
        """Run one tick with the inputs known at `now` (s) and publish the command."""
        inputs, config = self.inputs, self._config
        inputs.now, inputs.state = now - self.stalled, state
        inputs.velocity = _value_if_fresh(
            self._velocity, state.time, config.max_velocity_age, self._velocity_lead
        )
        inputs.command = _value_if_fresh(self._command, inputs.now, config.command_timeout)
        inputs.overruns = 0 if self._guards.robot_waits else self.stats.consecutive_overruns
        self._answer = self.supervisor.tick(inputs)
        inputs.stopped = 0.0
        self._publish(self._answer)

    def _resume(self, now: float) -> None:
        """Answer the waiting state if no node lags any more."""
        if self._waiting_state is not None and not self._outruns_others(self._waiting_state):
            self._answer_if_due(self._waiting_state, now, time.perf_counter())


def _value_if_fresh(stamped: Stamped | None, now: float, limit: float, ahead: float = 0.0) -> Array | None:
    """Return the value, or None if its time is more than `limit` (s) off, also into the future after a clock step.

    Args:
        stamped: Time (s) and value.
        now: Present time, s.
        limit: Age limit, s.
        ahead: Additional limit into the future, s: for a stall that this loop does not know yet.
    """
    return stamped[1] if stamped is not None and -limit - ahead <= now - stamped[0] <= limit else None
