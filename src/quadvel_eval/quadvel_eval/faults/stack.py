"""Connects the nodes' classes around a simulated robot by messages, in steps of 1 ms, for faults.

`RobotLoop` runs the same classes one after the other. Here, links delay, lose and corrupt
messages, processes stop, and clocks jump. Messages have single precision and pass through the
nodes' own readers, so that they refuse here what the nodes refuse. No ROS, no real time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.state import MODE_DAMPING, JointCommand, RobotState
from quadvel_driver.link import MAX_COMMAND_AGE_MS, clamp_for_board
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_estimator.learned import LearnedEstimator
from quadvel_estimator.tracker import VelocityTracker
from quadvel_nodes.messages import (
    MessageError,
    read_low_cmd,
    read_low_state,
    read_numbers,
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

Message = Any

STATE_PERIOD_MS = 5
COMMAND_PERIOD_MS = 20  # of planner and mux
EPOCH_S = 1000.0  # system time at the start of the simulation
PLANNER = MuxInput("planner", priority=0, timeout=0.5)


class Link:
    """Carries messages from one process to others, in order of arrival.

    Attributes:
        fault: Function from time (ms) and message to a list of (delay in ms, message); an empty
            list loses the message. None: the link works.
    """

    def __init__(self, *receivers: Callable[[Message], None]) -> None:
        self.fault: Callable[[int, Message], list[tuple[int, Message]]] | None = None
        self._receivers = receivers
        self._in_flight: list[tuple[int, int, Message]] = []
        self._count = 0

    def send(self, now: int, message: Message) -> None:
        """Send a message.

        Args:
            now: Time, ms.
            message: The message.
        """
        for delay, what in [(0, message)] if self.fault is None else self.fault(now, message):
            self._count += 1
            self._in_flight.append((now + delay, self._count, what))

    def deliver(self, now: int) -> None:
        """Deliver all messages that are due.

        Args:
            now: Time, ms.
        """
        while due := [one for one in self._in_flight if one[0] <= now]:
            first = min(due, key=lambda one: one[:2])
            self._in_flight.remove(first)
            for receive in self._receivers:
                receive(first[2])


class Process:
    """Process that handles its input immediately, later if stopped, and never if killed.

    Attributes:
        stopped: Whether input waits for `resume`; the queue keeps the newest ten.
        killed: Whether input is lost.
    """

    def __init__(self) -> None:
        self.stopped = self.killed = False
        self._inbox: deque[Callable[[], None]] = deque(maxlen=10)

    def submit(self, work: Callable[[], None]) -> None:
        """Run a job now, or queue it while the process is stopped.

        Args:
            work: The job.
        """
        if self.killed:
            return
        if self.stopped:
            self._inbox.append(work)
        else:
            work()

    def resume(self) -> None:
        """Continue with the queued jobs."""
        self.stopped = False
        while self._inbox:
            self._inbox.popleft()()


class Stack:
    """Planner, mux, estimator, controller, driver and robot, connected by faulty links.

    Args:
        simulator: The robot.
        policy: Policy of the controller.
        estimator: Velocity estimator.
        guards: Guards of the supervisor.

    Attributes:
        simulator: The robot.
        supervisor: Supervisor of the controller.
        now: Time, ms.
        links: Links "low_state", "low_cmd", "estimate", "command" and "cmd_vel".
        processes: Processes "controller", "estimator", "mux" and "planner".
        sensor_fault: Function from time (ms) and state to the reported state; None: no fault.
        clock_offset: Error of the machine's clock, s.
        extra_tick_time: Additional computing time of a controller tick, s.
        robot_command_mode: Mode of the command that is in force on the robot.
        planned_velocity: Velocity of the planner: vx, vy (m/s), wz (rad/s).
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
        self.robot_command_mode = MODE_DAMPING
        self.clock_offset = self.extra_tick_time = 0.0
        self.planned_velocity = np.zeros(3)
        self.sensor_fault: Callable[[int, RobotState], RobotState] | None = None
        self.processes = {name: Process() for name in ("controller", "estimator", "mux", "planner")}
        config, robot = ControlConfig(), simulator.config.robot
        self.supervisor = Supervisor(robot, policy, config.supervisor, KalmanEstimator(robot), guards)
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
        """Simulate one millisecond."""
        if self.now % STATE_PERIOD_MS == 0:
            self._report()
        if self.now % COMMAND_PERIOD_MS == 0:
            self.processes["planner"].submit(self._plan)
            self.processes["mux"].submit(self._arbitrate)
        for link in self.links.values():
            link.deliver(self.now)
        if self.now % round(1e3 * WATCH_PERIOD_S) == 7:  # arbitrary phase of the timer
            self.processes["controller"].submit(self._loop.watch)
        self.simulator.step()
        self.now += 1

    def _steady(self) -> float:
        """Steady clock, s."""
        return self.now * DT + self.extra_tick_time

    def _clock(self) -> float:
        """System clock, s."""
        return EPOCH_S + self._steady() + self.clock_offset

    def _stamp(self) -> float:
        """System clock without the additional computing time, s."""
        return EPOCH_S + self.now * DT + self.clock_offset

    # Work of the processes.

    def _report(self) -> None:
        """Robot: measure and send the state."""
        state = self.simulator.state()
        state.tick = self.now
        if self.sensor_fault is not None:
            state = self.sensor_fault(self.now, state)
        message = SimpleNamespace()
        write_low_state(state, message)
        message.stamp = _time(self._stamp())
        self.links["low_state"].send(self.now, message)

    def _plan(self) -> None:
        """Planner: send its velocity."""
        self.links["cmd_vel"].send(self.now, self.planned_velocity.copy())

    def _velocity_to_mux(self, velocity: Array) -> None:
        """Mux: take a velocity."""
        self.processes["mux"].submit(lambda: self._mux.receive(PLANNER.name, self._steady(), velocity))

    def _arbitrate(self) -> None:
        """Mux: send the command."""
        mux_output = self._mux.update(self._steady())
        message = SimpleNamespace(
            stamp=_time(self._stamp()),
            velocity=mux_output.velocity.astype(np.float32),
            stance=mux_output.stance,
        )
        self.links["command"].send(self.now, message)

    def _state_to_estimator(self, message: Message) -> None:
        """Estimator: take a state."""
        self.processes["estimator"].submit(lambda: self._estimate(message))

    def _estimate(self, message: Message) -> None:
        """Estimator: update, and send the velocity; invalid states are ignored."""
        try:
            estimate = self._tracker.process(read_low_state(message))
        except (MessageError, FloatingPointError):
            return
        if estimate is not None:
            answer = SimpleNamespace(stamp=message.stamp, velocity=estimate.velocity.astype(np.float32))
            self.links["estimate"].send(self.now, answer)

    def _command_to_estimator(self, message: Message) -> None:
        """Estimator: take the joint command, its previous action."""
        self.processes["estimator"].submit(
            lambda: self._tracker.set_command(self.simulator.config.robot, message.q, message.mode)
        )

    def _state_to_controller(self, message: Message) -> None:
        """Controller: take a state."""
        self._to_controller("low_state", lambda: self._loop.on_state(read_low_state(message)))

    def _velocity_to_controller(self, message: Message) -> None:
        """Controller: take a velocity estimate."""
        self._to_controller(
            "velocity_estimate",
            lambda: self._loop.on_velocity(seconds(message.stamp), read_numbers(message, "velocity", 3)),
        )

    def _command_to_controller(self, message: Message) -> None:
        """Controller: take a velocity command."""
        self._to_controller(
            "command",
            lambda: self._loop.on_command(
                seconds(message.stamp), read_numbers(message, "velocity", 3), message.stance
            ),
        )

    def _to_controller(self, topic: str, work: Callable[[], None]) -> None:
        """Run a job in the controller, with refused messages counted as the node does."""

        def refusing() -> None:
            try:
                work()
            except MessageError as error:  # as the node does, which also counts them
                self._loop.refuse(topic, error)

        self.processes["controller"].submit(refusing)

    def _answer(self, command: JointCommand) -> None:
        """Controller: send a joint command, after its additional computing time."""
        message = SimpleNamespace()
        write_low_cmd(command, message)
        message.stamp = _time(self._stamp())
        self.links["low_cmd"].send(self.now + round(1e3 * self.extra_tick_time), message)

    def _command_to_robot(self, message: Message) -> None:
        """Check and forward a command as the driver does."""
        try:
            command = read_low_cmd(message)
        except MessageError:
            return
        if 0 <= self.now - command.tick <= MAX_COMMAND_AGE_MS:
            self.robot_command_mode = command.mode
            self.simulator.command(clamp_for_board(command, self.simulator.config.robot))


def corrupt(message: Message, rng: np.random.Generator) -> Message:
    """Copy a message and replace about a third of its single precision numbers by random bits.

    Args:
        message: The message.
        rng: Random number generator.

    Returns:
        The corrupted copy.
    """
    spoilt = SimpleNamespace(**vars(message))
    for name, value in vars(message).items():
        if isinstance(value, np.ndarray) and value.dtype == np.float32:
            bits = rng.integers(0, 2**32, value.size, dtype=np.uint32).view(np.float32)
            bits = np.where(np.isnan(bits), np.float32(np.nan), bits)  # canonical quiet NaN
            setattr(spoilt, name, np.where(rng.random(value.size) < 0.3, bits, value))
    return spoilt


def _time(seconds: float) -> Message:
    """Time in s as a ROS 2 time message."""
    whole = int(seconds)
    return SimpleNamespace(sec=whole, nanosec=int(1e9 * (seconds - whole)))
