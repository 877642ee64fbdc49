"""Measures the running stack against a floor (`quadvel bench --live`).

The stack runs as `quadvel up --headless` starts it, and walks straight ahead. `live_floor` runs
next to it and shows what the middleware, the network and the machine cost without the stack's own
work. All figures of one run belong together; only their ratios carry over to other machines.

An answer time is the time from the publication of a state to the publication of the message that
answers it, as the middleware stamps both. It contains wake-up, computing and writing, not the
simulator's own work before the state. A deadline is missed if no answer leaves within one period
after the stamp of the state.
"""

from __future__ import annotations

import json
import math
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any

import numpy as np
import typer

import quadvel_dds

quadvel_dds.install()  # before anything imports rclpy

# ruff: noqa: E402
from geometry_msgs.msg import Twist, TwistWithCovarianceStamped

from quadvel_bringup.exclusivity import domain_claimed
from quadvel_bringup.nodes import ros_arguments
from quadvel_bringup.processes import ProcessGroup, StopSignals
from quadvel_bringup.session import Session, not_running
from quadvel_bringup.stack import Stack
from quadvel_description.arrays import Array
from quadvel_eval.bench import WALK_COMMAND, Benchmark
from quadvel_msgs.msg import ControllerState, LowCmd, LowState
from quadvel_policy.observation import CONTROL_PERIOD_S

NODES = tuple(Stack().node_parameters())
PROCESSES = (*NODES, "floor")
FLOOR = [sys.executable, "-m", "quadvel_lab.live_floor"]
ANSWERS = {
    "floor": (LowCmd, "floor/low_cmd", 1),
    "controller": (LowCmd, "low_cmd", 1),
    "estimator": (TwistWithCovarianceStamped, "velocity_estimate", 0),
}
"""Type and topic of the answers to states by process, and the column of `Traffic` that names the state."""
PERIOD_US = 1e6 * CONTROL_PERIOD_S
START_TIMEOUT_S = 60.0
SETTLING_TIME_S = 3.0
"""Time of walking before the measurement."""
POLL_PERIOD_S, POLL_TIME_S = 0.1, 0.02
"""Time between two looks at the received messages, and duration of one: rare, to disturb little."""
QUEUE = 1000
"""Largest number of messages between two looks."""
HEAD = struct.Struct("<4xiII")
"""Start of a message in CDR: encapsulation, stamp (s, ns), and the tick of LowState and LowCmd."""
CPU_TARGETS = {"controller": "600", "estimator": "350", "command_mux": "100", "sim_node": "1500"}
RATIO_TARGETS = {"p50": "2 or less", "p99": "2.5 or less"}
QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}


class Traffic:
    """Messages of a topic: their stamps, ticks, and times of publication.

    Attributes:
        rows: Stamp (ns), tick, time of publication (ns).
    """

    def __init__(self, node: Any, kind: Any, topic: str) -> None:
        """Subscribe to a topic.

        Args:
            node: The node that it uses.
            kind: Class of the messages, which begin with a stamp.
            topic: The topic.
        """
        self.rows: list[tuple[int, int, int]] = []
        node.create_subscription(kind, topic, self._receive, QUEUE, raw=True)

    def _receive(self, data: bytes, information: Any) -> None:
        seconds, nanoseconds, tick = HEAD.unpack_from(data)
        self.rows.append((seconds * 10**9 + nanoseconds, tick, information["source_timestamp"]))


def answer_times(states: Traffic, answers: Traffic, key: int, column: int = 2) -> Array:
    """Return the times from the publication of each state to its answer.

    Args:
        states: The states.
        answers: Their answers.
        key: Column by which an answer names its state: 0 stamp, 1 tick.
        column: Column with the time of the answer: 2 publication, 0 stamp.

    Returns:
        Times, (n,), us; infinity without an answer.
    """
    answered = {row[key]: row[column] for row in reversed(answers.rows)}  # the first answer counts
    return np.array([1e-3 * (answered.get(row[key], math.inf) - row[2]) for row in states.rows])


def missed_deadlines(states: Traffic, times: Array) -> float:
    """Return how many of 10,000 states got no answer within one period after their stamp.

    Args:
        states: The states.
        times: Their answer times, (n,), us.

    Returns:
        Number of missed deadlines in 10,000.
    """
    age = np.array([1e-3 * (published - stamp) for stamp, _, published in states.rows])
    return float(1e4 * np.mean(age + times > PERIOD_US))


def processor_time(process: int) -> float:
    """Return the processor time that a process has used.

    Args:
        process: Its id.

    Returns:
        Time of all its threads, s.
    """
    return time.clock_gettime(~process << 3 | 2)  # as clock_getcpuclockid(3) on Linux


class LiveRun:
    """The processes of stack and floor, and a session that commands and observes them; a context manager."""

    def __init__(self) -> None:
        self._output: list[str] = []

    def __enter__(self) -> LiveRun:
        """Start the processes."""
        with ExitStack() as stack:
            self._signals = stack.enter_context(StopSignals())
            self._session = stack.enter_context(Session("live_bench"))
            stack.enter_context(domain_claimed(self._session.node))
            group = ProcessGroup(lambda name, line: self._output.append(f"{name}: {line}"))
            self._group = stack.enter_context(group)
            for name, line in {**Stack().commands(), "floor": [*FLOOR, *ros_arguments("floor", {})]}.items():
                group.start(name, line)
            self._drive = self._session.node.create_publisher(Twist, "cmd_vel", 1)
            self._reports = self._session.listen(ControllerState, "controller/state")
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def measure(self, seconds: float, busy: int) -> dict[str, Any]:
        """Let the robot walk and measure.

        Args:
            seconds: Duration, s.
            busy: Number of other processes that compute without a pause.

        Returns:
            Figures of `run_figures`, and of the sleep loop.

        Raises:
            typer.Exit: A signal ended the run.
            NotRunningError: The robot does not walk.
        """
        if not self._command(
            0.0, START_TIMEOUT_S, lambda: bool(self._reports and self._reports[-1].walk_allowed)
        ):
            raise self._not_walking()
        states = Traffic(self._session.node, LowState, "low_state")
        answers = {
            name: Traffic(self._session.node, kind, topic) for name, (kind, topic, _) in ANSWERS.items()
        }
        for _ in range(busy):
            self._stack.callback(subprocess.Popen([sys.executable, "-c", "while True: pass"]).kill)
        self._command(WALK_COMMAND[0], SETTLING_TIME_S)
        for traffic in (states, *answers.values()):
            traffic.rows.clear()
        sleeper = subprocess.Popen([*FLOOR, str(seconds)], stdout=subprocess.PIPE)
        self._stack.callback(sleeper.kill)
        before = self._processor_times()
        self._command(WALK_COMMAND[0], seconds)
        used = {name: now - before[name] for name, now in self._processor_times().items()}
        if self._reports[-1].mode_name != "walk":
            raise self._not_walking()
        sleep = json.loads(sleeper.communicate()[0])
        return run_figures(states, answers, used) | {f"sleep_{name}": value for name, value in sleep.items()}

    def _processor_times(self) -> dict[str, float]:
        """Return the processor time, s, of each process by name."""
        return {name: processor_time(self._group.process_id(name)) for name in PROCESSES}

    def _command(self, velocity: float, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Command a velocity (m/s) for a time (s) or until a predicate holds; return whether it holds."""
        end, twist = time.monotonic() + seconds, Twist()
        twist.linear.x = velocity
        while not until() and time.monotonic() < end:
            if self._signals.received:
                raise typer.Exit(128 + self._signals.received)
            if self._group.ended() or (self._reports and self._reports[-1].fault):
                raise self._not_walking()
            self._drive.publish(twist)
            time.sleep(POLL_PERIOD_S)
            self._session.spin(POLL_TIME_S)
        return until()

    def _not_walking(self) -> Exception:
        return not_running(self._session.node, f"the robot does not walk: {'; '.join(self._output[-3:])}")


def run_figures(
    states: Traffic, answers: Mapping[str, Traffic], used: Mapping[str, float]
) -> dict[str, float]:
    """Compute the figures of processes.

    Args:
        states: The states of the run.
        answers: The answers by process of ANSWERS.
        used: Processor time of each process, s.

    Returns:
        Processor time a tick, answer times and missed deadlines by process, and ratios to the floor.
    """
    figures = {f"{name}_cpu_us": 1e6 * seconds / len(states.rows) for name, seconds in used.items()}
    figures["stack_cpu_percent"] = 100.0 * sum(figures[f"{name}_cpu_us"] for name in NODES) / PERIOD_US
    figures |= quantiles("floor_wake", answer_times(states, answers["floor"], key=1, column=0))
    for name, (_, _, key) in ANSWERS.items():
        times = answer_times(states, answers[name], key)
        figures |= quantiles(name, times)
        figures[f"{name}_missed"] = missed_deadlines(states, times)
    return figures | ratios(figures)


def quantiles(name: str, times: Array) -> dict[str, float]:
    """Return the percentiles of the finite times.

    Args:
        name: Prefix of their names.
        times: Times, (n,), us.

    Returns:
        Percentiles, us, by name.
    """
    answered = times[np.isfinite(times)]
    return {f"{name}_{share}_us": float(np.quantile(answered, value)) for share, value in QUANTILES.items()}


def ratios(figures: dict[str, float]) -> dict[str, float]:
    """Compare the processes with the floor.

    Args:
        figures: Figures in us by process and quantity, such as `controller_cpu_us`.

    Returns:
        Each figure of another process divided by that of the floor, such as `controller_cpu_ratio`.
    """
    return {
        f"{name}_{quantity}_ratio": figures[f"{name}_{quantity}_us"] / figures[f"floor_{quantity}_us"]
        for name in NODES
        for quantity in ("cpu", *QUANTILES)
        if f"{name}_{quantity}_us" in figures
    }


def _rows() -> Iterator[tuple[str, str, str]]:
    """Yield the rows of the table: name of the figure, description, target."""
    for name in (*PROCESSES, "sleep"):
        yield f"{name}_cpu_us", f"{name}, processor time a tick, us", CPU_TARGETS.get(name, "")
        if name in NODES:
            yield (
                f"{name}_cpu_ratio",
                "    divided by that of the floor",
                "2.5 or less" * (name == "controller"),
            )
    yield "stack_cpu_percent", "all nodes in real time, % of one core", "70 or less"
    for share in QUANTILES:
        yield f"sleep_{share}_us", f"sleep, lateness, {share}, us", ""
        yield f"floor_wake_{share}_us", f"floor, from the state to its receipt, {share}, us", ""
        for name in ANSWERS:
            yield f"{name}_{share}_us", f"{name}, from state to answer, {share}, us", ""
            if name in NODES:
                target = RATIO_TARGETS.get(share, "") if name == "controller" else ""
                yield f"{name}_{share}_ratio", "    divided by that of the floor", target
    for name in ANSWERS:
        yield f"{name}_missed", f"{name}, missed deadlines in 10,000", ""


def live_benchmark(seconds: float, busy: int) -> Benchmark:
    """Return the benchmark; an entry point of the group `quadvel.live_benchmarks` names this function.

    Args:
        seconds: Duration of the measurement, s.
        busy: Number of other processes that compute without a pause.

    Returns:
        The benchmark.
    """

    def measure() -> dict[str, Any]:
        with LiveRun() as run:
            return run.measure(seconds, busy)

    return Benchmark(measure, tuple(_rows()))
