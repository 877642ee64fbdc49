"""When the controller ticks, and what it knows then: states, velocities and commands as they come in, a command out.

It is locked to the phase of the states: a tick runs when the state that is due arrives, so that the latency is small and
constant. What is due lies on an absolute grid in the states' own time (`TickGrid`), so that states may come faster than
200 Hz; the deadline of a tick is one period after its state held. When states stop, `watch` notices. With simulated time the
same holds on that time, and the answer waits until estimator and mux have kept up, so that no node is outrun. What a tick
decides is the supervisor's matter. Knows no ROS: times come in as numbers, in s.

All times but that of the clock are the robot's own (`RobotTime`): a stall of the whole machine, simulator included, is no gap
in them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.state import JointCommand, RobotState
from quadvel_nodes.messages import MessageError
from quadvel_nodes.scheduling import Scheduling
from quadvel_nodes.stall_free_clock import StallFreeClock
from quadvel_nodes.tick_grid import TickGrid

from .guard import FALL_TIME
from .loop_stats import LoopStats
from .observation import RATE_HZ
from .received import StampCheck
from .settings import setting
from .stall_detector import StallDetector
from .supervisor import Supervisor, SupervisorConfig

Array = NDArray[np.float64]

PERIOD = 1.0 / RATE_HZ
WATCH_PERIOD = 0.02
"""s from one `watch` to the next"""
LONGEST = 0.5
"""s that a robot may have stood still, with all of the machine, before its next state, and that a simulated robot waits for a
node that is behind: half of the time for which a simulator waits for its answer"""
LOCKSTEP_PATIENCE = 2.0
"""s of real time that a robot in lockstep waits for a node that is behind"""

CLOCK_STEP = 0.02
"""s by which a clock has to run away from the steady one at once to have been set; both have to be read within half of it"""

Stamped = tuple[float, Array]
"""Time (s) and value"""


@attrs.frozen(kw_only=True)
class ControlConfig(SupervisorConfig, Scheduling):
    """The supervisor's settings and the scheduling, and how old what comes in may be."""

    max_velocity_age: float = setting(
        0.05,
        "oldest velocity estimate that is followed; after that it is the Kalman filter's, s",
        at_most=FALL_TIME,
    )
    command_timeout: float = setting(
        0.5, "oldest command that is followed; after that the robot stands, s", at_most=FALL_TIME
    )


@attrs.define
class _Companion:
    """A node whose messages a simulated robot waits for, so that it does not outrun it: not for ever, and no more then until
    the node is heard again.

    behind: s that its newest message may be behind the robot. patience: s that the robot waits.
    """

    behind: float
    patience: float
    _since: float | None = None

    def heard(self) -> None:
        """A message came."""
        self._since = None

    def holds_up(self, age: float, now: float) -> bool:
        """Whether the robot is to wait. age: s, of the newest message, in the robot's time. now: s, steady."""
        if age <= self.behind:
            return False
        if self._since is None:
            self._since = now
        return now - self._since <= self.patience


class ControlLoop:
    """One supervisor in time. `answer` is called with each command; `clock` (s) is that of the stamps.

    sim_time: whether that clock is a simulator's in lockstep, which waits for the answer to each of its states. steady: a clock
    (s) that nobody sets, by which one learns that the other one was set; None where that one cannot be.
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
        self.supervisor = supervisor
        self.stats = LoopStats()
        self.pauses = StallDetector(WATCH_PERIOD, PERIOD)
        self.state: RobotState | None = None
        self._config, self._publish, self._sim_time = config, answer, sim_time
        self._clock, self._steady = clock, steady or clock
        self._ahead_of_steady = self._clock() - self._steady()
        self._patience = (
            math.inf if config.robot_waits else 0.0
        )  # s by which a velocity may be late as nobody ran
        self._robot_time, self._grid = StallFreeClock(), TickGrid(PERIOD)
        self._waiting: RobotState | None = None  # for the estimator or the mux
        patience = LOCKSTEP_PATIENCE if sim_time else LONGEST
        self._estimator = _Companion(1.5 * PERIOD, patience)
        self._mux = _Companion(0.5 * config.command_timeout if sim_time else math.inf, patience)
        self._answer = JointCommand.damping()
        self._velocity: Stamped | None = None
        self._command: Stamped | None = None
        self._checks = {
            "low_state": StampCheck(config.max_silence),
            "waiting": StampCheck(config.max_silence),
            "velocity_estimate": StampCheck(config.max_velocity_age + self._patience),
            "command": StampCheck(config.command_timeout),
        }

    @property
    def stalled(self) -> float:
        """s that the robot stood still together with the machine, since the start."""
        return self._robot_time.stalled

    def on_state(self, state: RobotState) -> None:
        """A state whose `time` is its stamp. Raises MessageError where that is not fit."""
        start = time.perf_counter()
        now = self._accept("low_state", state.time)
        self.pauses.poll(now)
        longest = max(LONGEST if self.pauses.since_heard else 0.0, self._config.max_silence)
        state.time = self._robot_time.follow(state.time, state.tick, longest)
        self.supervisor.stopped += self.pauses.lost
        self.pauses.heard()
        if self._outruns_others(state):
            self._waiting = state
        else:
            self._take(state, now, start)

    def on_waiting(self, stamp: float, tick: int) -> None:
        """The robot says at `stamp` (s) that its time stands still at `tick`; an unknown tick excuses nothing.

        Raises MessageError where the stamp is not fit.
        """
        now = self._accept("waiting", stamp)
        if self.state is not None and tick == self._robot_time.tick:
            self._robot_time.follow(stamp, tick, waiting=True)
        self._resume(now)

    def on_velocity(self, stamp: float, velocity: Array) -> None:
        """A velocity estimate, (3,) m/s, body frame. Raises MessageError where its stamp is not fit."""
        now = self._accept("velocity_estimate", stamp)
        self._velocity = self._robot_time.at(stamp), velocity
        self._estimator.heard()
        self._resume(now)

    def on_command(self, stamp: float, velocity: ArrayLike, stance: bool) -> None:
        """A command, vx, vy (m/s), wz (rad/s), and whether to stand. Raises MessageError where its stamp is not fit."""
        now = self._accept("command", stamp)
        self._command = self._robot_time.at(stamp), np.append(velocity, float(stance))
        self._mux.heard()
        self._resume(now)

    def refuse(self, topic: str, why: MessageError) -> None:
        """A message of one of these topics was refused: the guards learn why, until a fit one comes.

        What refused messages have in common in the end, that they are old, does not hide what was wrong with the first of them.
        """
        if type(why) is not MessageError or topic not in self.supervisor.refused:
            self.supervisor.refused[topic] = why

    def watch(self) -> None:
        """Every WATCH_PERIOD: let the supervisor learn when states stop, or when none is fit to use any more."""
        now = self._now()
        self.pauses.poll(now)
        if self.state is None:
            return
        refused = "low_state" in self.supervisor.refused
        limit = self._config.max_state_age if refused else self._config.max_silence
        if now - self.stalled - self.state.time > limit and not self.pauses.excuse(now):
            self._tick(self.state, now)

    def _now(self, stamp: float = 0.0) -> float:
        """The clock of the stamps, s. Simulated time may reach this node after what was stamped with it."""
        before, now = self._steady(), self._clock()
        ahead = now - before
        if abs(ahead - self._ahead_of_steady) > CLOCK_STEP and self._steady() - before < 0.5 * CLOCK_STEP:
            self._robot_time.clock_was_set(ahead - self._ahead_of_steady)
            self._ahead_of_steady = ahead
        return max(now, stamp) if self._sim_time else now

    def _accept(self, topic: str, stamp: float) -> float:
        now = self._now(stamp)
        self._checks[topic].check(stamp, now)
        self.supervisor.refused.pop(topic, None)
        return now

    def _outruns_others(self, state: RobotState) -> bool:
        """Whether a simulator shall wait until the estimator, and in lockstep the mux, have kept up."""
        if not (self._sim_time or self._config.robot_waits):
            return False
        now = time.monotonic()
        known = ((self._velocity, self._estimator), (self._command, self._mux))
        return any(last is not None and node.holds_up(state.time - last[0], now) for last, node in known)

    def _take(self, state: RobotState, now: float, start: float) -> None:
        """Answer the state if it is due. now, start: when that began, s, on the clock and on the steady clock."""
        self._waiting = None
        periods = self._grid.periods(state.time)
        if periods:
            self._tick(state, now)
            compute = time.perf_counter() - start
            late = self._now() - self.stalled - state.time > PERIOD
            self.stats.add(start, compute, self.supervisor.inference_seconds, periods - 1 + late)
            self.supervisor.prepare()
        elif self._sim_time:  # a simulator in lockstep waits for the answer to each of its states
            self._answer.tick = state.tick
            self._publish(self._answer)

    def _tick(self, state: RobotState, now: float) -> None:
        """One tick of the supervisor, and its command. now: s, on the clock; it is judged by what was known then."""
        self.supervisor.overruns = 0 if self._config.robot_waits else self.stats.in_a_row
        self.state = state
        now -= self.stalled
        velocity = _fresh(self._velocity, state.time, self._config.max_velocity_age, self._patience)
        command = _fresh(self._command, now, self._config.command_timeout)
        self._answer = self.supervisor.tick(now, state, velocity, command)
        self.supervisor.stopped = 0.0
        self._publish(self._answer)

    def _resume(self, now: float) -> None:
        """Answer the state that waited, if nothing is behind any more."""
        if self._waiting is not None and not self._outruns_others(self._waiting):
            self._take(self._waiting, now, time.perf_counter())


def _fresh(stamped: Stamped | None, now: float, limit: float, ahead: float = 0.0) -> Array | None:
    """The value, unless its time is more than `limit` (s) off, to come where the clock was set back.

    ahead: how much more it may be to come, s: of a state after a standstill that this loop does not know of yet.
    """
    return stamped[1] if stamped is not None and -limit - ahead <= now - stamped[0] <= limit else None
