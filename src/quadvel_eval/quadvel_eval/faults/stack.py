"""The nodes' classes around one simulated robot, as messages connect them, at the pace of a millisecond. No ROS, no real time.

Unlike `RobotLoop`, which runs them one after the other, this has links that take time, lose and spoil messages, processes that
stop, and clocks that jump: it is there to break things. Messages carry single precision and are read by the nodes' own readers, so
that what a node refuses is refused here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadvel_description.state import MODE_DAMPING, JointCommand, RobotState
from quadvel_driver.link import MAX_COMMAND_AGE_MS, clamp_for_board
from quadvel_estimator.features import previous_action
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_estimator.learned import LearnedEstimator
from quadvel_estimator.tracker import VelocityTracker
from quadvel_nodes.messages import (
    MessageError,
    numbers,
    read_low_cmd,
    read_low_state,
    seconds,
    write_low_cmd,
    write_low_state,
)
from quadvel_policy.command_mux import CommandMux, MuxInput
from quadvel_policy.control_loop import WATCH_PERIOD_S, ControlConfig, ControlLoop
from quadvel_policy.guard import Guard
from quadvel_policy.guards import GUARDS
from quadvel_policy.policy_file import PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_sim.simulator import DT, Simulator

Array = NDArray[np.float64]
Message = Any

STATE_PERIOD = 5  # ms
COMMAND_PERIOD = 20  # ms, of planner and mux
EPOCH = 1000.0  # s, what the machine's clock shows when the simulation begins
PLANNER = MuxInput("planner", priority=0, timeout=0.5)


class Link:
    """Carries messages from one process to others, in order of arrival.

    way: what happens to a message on it, as a list of (delay in ms, message); one that is lost makes none. None: nothing.
    """

    def __init__(self, *receivers: Callable[[Message], None]) -> None:
        self.way: Callable[[int, Message], list[tuple[int, Message]]] | None = None
        self._receivers = receivers
        self._under_way: list[tuple[int, int, Message]] = []
        self._count = 0

    def send(self, now: int, message: Message) -> None:
        """Send at `now` (ms)."""
        for delay, what in [(0, message)] if self.way is None else self.way(now, message):
            self._count += 1
            self._under_way.append((now + delay, self._count, what))

    def deliver(self, now: int) -> None:
        """Hand over all that is due at `now` (ms)."""
        while due := [one for one in self._under_way if one[0] <= now]:
            first = min(due, key=lambda one: one[:2])
            self._under_way.remove(first)
            for receive in self._receivers:
                receive(first[2])


class Process:
    """A process that takes what comes in, at once; one that is stopped does so when it goes on, and never where it is killed."""

    def __init__(self) -> None:
        self.stopped = self.killed = False
        self._inbox: deque[Callable[[], None]] = deque(maxlen=10)

    def do(self, work: Callable[[], None]) -> None:
        """Do `work`, now or later."""
        if self.killed:
            return
        if self.stopped:
            self._inbox.append(work)
        else:
            work()

    def resume(self) -> None:
        """Go on with what has come meanwhile."""
        self.stopped = False
        while self._inbox:
            self._inbox.popleft()()


class Stack:
    """Planner, mux, estimator, controller, driver and robot.

    links: "low_state", "low_cmd", "estimate", "command", "cmd_vel". processes: "controller", "estimator", "mux", "planner".
    sensors: what happens to a state before it leaves the robot, None for nothing. clock_offset: s by which the machine's clock
    was set. late: s that the controller takes for a tick beyond what it takes here. held_mode: of the command that the robot
    holds. velocity: what the planner wants.
    """

    def __init__(
        self,
        simulator: Simulator,
        policy: PolicyFile,
        estimator: LearnedEstimator,
        guards: tuple[type[Guard], ...] = GUARDS,
    ) -> None:
        self.simulator = simulator
        self.now = 0  # ms
        self.held_mode = MODE_DAMPING
        self.clock_offset = self.late = 0.0
        self.velocity = np.zeros(3)
        self.sensors: Callable[[int, RobotState], RobotState] | None = None
        self.processes = {name: Process() for name in ("controller", "estimator", "mux", "planner")}
        config = ControlConfig()
        self.supervisor = Supervisor(policy, config, KalmanEstimator(), guards)
        self._loop = ControlLoop(self.supervisor, config, self._answer, self._clock, steady=self._steady)
        self._tracker = VelocityTracker(estimator)
        self._mux = CommandMux([PLANNER])
        self.links = {
            "low_state": Link(self._state_to_controller, self._state_to_estimator),
            "low_cmd": Link(self._command_to_robot, self._command_to_estimator),
            "estimate": Link(self._velocity_to_controller),
            "command": Link(self._command_to_controller),
            "cmd_vel": Link(self._velocity_to_mux),
        }

    def step(self) -> None:
        """One millisecond."""
        if self.now % STATE_PERIOD == 0:
            self._report()
        if self.now % COMMAND_PERIOD == 0:
            self.processes["planner"].do(self._plan)
            self.processes["mux"].do(self._arbitrate)
        for link in self.links.values():
            link.deliver(self.now)
        if self.now % round(1e3 * WATCH_PERIOD_S) == 7:  # a timer has a phase of its own
            self.processes["controller"].do(self._loop.watch)
        self.simulator.step()
        self.now += 1

    def _steady(self) -> float:
        return self.now * DT + self.late

    def _clock(self) -> float:
        return EPOCH + self._steady() + self.clock_offset

    def _stamp(self) -> float:
        return EPOCH + self.now * DT + self.clock_offset

    # What each process does.

    def _report(self) -> None:
        state = self.simulator.state()
        state.tick = self.now
        if self.sensors is not None:
            state = self.sensors(self.now, state)
        message = SimpleNamespace()
        write_low_state(state, message)
        message.stamp = _time(self._stamp())
        self.links["low_state"].send(self.now, message)

    def _plan(self) -> None:
        self.links["cmd_vel"].send(self.now, self.velocity.copy())

    def _velocity_to_mux(self, velocity: Array) -> None:
        self.processes["mux"].do(lambda: self._mux.receive(PLANNER.name, self._steady(), velocity))

    def _arbitrate(self) -> None:
        asked = self._mux.update(self._steady())
        message = SimpleNamespace(
            stamp=_time(self._stamp()), velocity=asked.velocity.astype(np.float32), stance=asked.stance
        )
        self.links["command"].send(self.now, message)

    def _state_to_estimator(self, message: Message) -> None:
        self.processes["estimator"].do(lambda: self._estimate(message))

    def _estimate(self, message: Message) -> None:
        try:
            estimate = self._tracker.process(read_low_state(message))
        except (MessageError, FloatingPointError):
            return
        if estimate is not None:
            answer = SimpleNamespace(stamp=message.stamp, velocity=estimate.velocity.astype(np.float32))
            self.links["estimate"].send(self.now, answer)

    def _command_to_estimator(self, message: Message) -> None:
        self.processes["estimator"].do(
            lambda: self._tracker.set_previous_action(previous_action(message.q, message.mode))
        )

    def _state_to_controller(self, message: Message) -> None:
        self._to_controller("low_state", lambda: self._loop.on_state(read_low_state(message)))

    def _velocity_to_controller(self, message: Message) -> None:
        self._to_controller(
            "velocity_estimate",
            lambda: self._loop.on_velocity(seconds(message.stamp), numbers(message, "velocity", 3)),
        )

    def _command_to_controller(self, message: Message) -> None:
        self._to_controller(
            "command",
            lambda: self._loop.on_command(
                seconds(message.stamp), numbers(message, "velocity", 3), message.stance
            ),
        )

    def _to_controller(self, topic: str, work: Callable[[], None]) -> None:
        def refusing() -> None:
            try:
                work()
            except MessageError as error:  # as the node does, which counts them, too
                self._loop.refuse(topic, error)

        self.processes["controller"].do(refusing)

    def _answer(self, command: JointCommand) -> None:
        message = SimpleNamespace()
        write_low_cmd(command, message)
        message.stamp = _time(self._stamp())
        self.links["low_cmd"].send(self.now + round(1e3 * self.late), message)

    def _command_to_robot(self, message: Message) -> None:
        """As the driver does, the last before the robot's board."""
        try:
            command = read_low_cmd(message)
        except MessageError:
            return
        if 0 <= self.now - command.tick <= MAX_COMMAND_AGE_MS:
            self.held_mode = command.mode
            self.simulator.command(clamp_for_board(command))


def spoil(message: Message, rng: np.random.Generator) -> Message:
    """A copy whose numbers of single precision are random bits, about a third of them."""
    spoilt = SimpleNamespace(**vars(message))
    for name, value in vars(message).items():
        if isinstance(value, np.ndarray) and value.dtype == np.float32:
            bits = rng.integers(0, 2**32, value.size, dtype=np.uint32).view(np.float32)
            bits = np.where(np.isnan(bits), np.float32(np.nan), bits)  # a quiet one
            setattr(spoilt, name, np.where(rng.random(value.size) < 0.3, bits, value))
    return spoilt


def _time(seconds: float) -> Message:
    whole = int(seconds)
    return SimpleNamespace(sec=whole, nanosec=int(1e9 * (seconds - whole)))
