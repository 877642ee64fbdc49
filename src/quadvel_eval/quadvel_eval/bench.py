"""Benchmarks the speed of simulator, networks and transport (`quadvel bench`).

Other packages add parts by entry points of the group `quadvel.benchmarks`, each naming a `Benchmark`,
and parts that start nodes by those of the group `quadvel.live_benchmarks` (`quadvel bench --live`).

One run measures everything, so that ratios hold where absolute figures vary between machines.
Times are medians, which ignore interruptions by other programs.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from functools import partial
from importlib import metadata
from typing import Any

import attrs
import numpy as np
import onnxruntime
from rich.table import Table
from typing_extensions import override

from quadvel_description.onnx_format import float_value, message, serialise
from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_description.state import JointCommand
from quadvel_driver import wire
from quadvel_driver.board_state import BoardState
from quadvel_driver.unitree_dds import wire as dds_wire
from quadvel_estimator.learned import LearnedEstimator
from quadvel_nodes.number_text import number_text
from quadvel_policy.observation import CONTROL_PERIOD_S
from quadvel_policy.policy_file import PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_policy.tick_input import TickInput
from quadvel_sim import Simulator, SimulatorConfig, World

from . import round_trip
from .robot_loop import SIMULATOR_STEPS_PER_TICK, RobotLoop, TrueVelocity
from .walk import Setup, make_loop, make_simulator

WALK_COMMAND = (0.5, 0.0, 0.0)
SCHEMA = 1
GROUP = "quadvel.benchmarks"
"""Entry points of other packages, each naming a `Benchmark`."""
LIVE_GROUP = "quadvel.live_benchmarks"
"""Entry points that name a function: duration (s) and number of busy processes to a `Benchmark`."""


@attrs.frozen
class Benchmark:
    """One part of the benchmark.

    Attributes:
        measure: Function that returns the figures, or their absence as {"skipped": reason}.
        rows: Rows of the table: name of the figure, description, target.
    """

    measure: Callable[[], dict[str, Any]]
    rows: tuple[tuple[str, str, str], ...]


def machine_info() -> dict[str, Any]:
    """Return number of cores and versions of Python and packages.

    Returns:
        Values for the file.
    """
    packages = {name: metadata.version(name) for name in ("mujoco", "numpy", "onnxruntime")}
    return {"cores": len(os.sched_getaffinity(0)), "python": platform.python_version(), **packages}


def _percentiles(seconds: list[float]) -> dict[str, float]:
    """Median and 99th percentile of durations in seconds, in us."""
    p50, p99 = 1e6 * np.quantile(seconds, (0.5, 0.99))
    return {"p50_us": float(p50), "p99_us": float(p99)}


def _time_calls(
    job: Callable[[], object], count: int, before: Callable[[], object] = lambda: None
) -> list[float]:
    """Seconds of each of `count` calls after a warm-up; `before` runs untimed before each call."""
    times = []
    for _ in range(count + count // 10):
        before()
        start = time.perf_counter()
        job()
        times.append(time.perf_counter() - start)
    return times[-count:]


def bench_simulator() -> dict[str, Any]:
    """Time the simulator with a standing robot, without and with sensors at 200 Hz.

    Returns:
        Realtime factors.
    """
    robot = make_simulator(Setup(), seed=0)
    command = JointCommand(q=load_robot(DEFAULT_ROBOT).nominal_q, kp=np.full(12, 100.0), kd=np.full(12, 3.0))

    def step() -> None:
        robot.command(command)
        robot.step(SIMULATOR_STEPS_PER_TICK)

    def step_and_read() -> None:
        step()
        robot.state()

    alone, read = _time_calls(step, 2000), _time_calls(step_and_read, 2000)
    return {
        "realtime_factor": CONTROL_PERIOD_S / float(np.median(alone)),
        "with_sensors_realtime_factor": CONTROL_PERIOD_S / float(np.median(read)),
    }


def bench_world() -> dict[str, Any]:
    """Time the simulator in the campus world, and one laser scan there.

    Returns:
        Realtime factor, and time of a scan in us.
    """
    campus = World.load("campus")
    robot = Simulator(SimulatorConfig(robot=load_robot(DEFAULT_ROBOT), world=campus))
    robot.reset("stand")
    command = JointCommand(q=load_robot(DEFAULT_ROBOT).nominal_q, kp=np.full(12, 100.0), kd=np.full(12, 3.0))

    def step() -> None:
        robot.command(command)
        robot.step(SIMULATOR_STEPS_PER_TICK)

    stepping, scanning = (
        _time_calls(step, 1000),
        _time_calls(robot.scan, 50, lambda: robot.step(campus.laser.period)),
    )
    return {
        "realtime_factor": CONTROL_PERIOD_S / float(np.median(stepping)),
        "scan_p50_us": _percentiles(scanning)["p50_us"],
    }


def bench_loop() -> dict[str, Any]:
    """Time the evaluation loop while walking, with both shadow estimators.

    Returns:
        Realtime factor.
    """
    walking = make_loop(Setup(), seed=0)
    times = _time_calls(lambda: walking.tick(WALK_COMMAND), 600)
    return {"realtime_factor": CONTROL_PERIOD_S / float(np.median(times))}


def bench_policy() -> dict[str, Any]:
    """Time the inference of the policy.

    `p50_us` and `p99_us` measure steps without a pause. `rested` measures the step after 5 ms of
    sleep, when other programs have used the caches; `rested_idle` shows that cost for a network
    that does nothing.

    Returns:
        Medians and a 99th percentile, us.
    """
    network = PolicyFile(load_robot(DEFAULT_ROBOT))
    observation = np.zeros(network.metadata.observation.size, np.float32)
    idle = _idle_network()

    def step() -> None:
        network.step(observation)

    rest = partial(time.sleep, CONTROL_PERIOD_S)
    medians = {
        "rested_p50_us": _time_calls(step, 400, rest),
        "rested_idle_p50_us": _time_calls(idle, 400, rest),
    }
    return _percentiles(_time_calls(step, 5000)) | {
        name: _percentiles(times)["p50_us"] for name, times in medians.items()
    }


def _idle_network() -> Callable[[], object]:
    """Return a function that runs the smallest network: the identity of one number."""
    graph = message(
        "GraphProto",
        node=message("NodeProto", input="x", output="y", op_type="Identity"),
        name="idle",
        input=float_value("x", [1]),
        output=float_value("y", [1]),
    )
    opset = message("OperatorSetIdProto", version=17)
    model = message("ModelProto", ir_version=8, graph=graph, opset_import=opset)
    session = onnxruntime.InferenceSession(serialise(model), providers=["CPUExecutionProvider"])
    x = {"x": np.zeros(1, np.float32)}
    return lambda: session.run(None, x)


def bench_estimator() -> dict[str, Any]:
    """Time the learned estimator from state to velocity.

    Returns:
        Median and 99th percentile, us.
    """
    network, state = LearnedEstimator(load_robot(DEFAULT_ROBOT)), make_simulator(Setup(), seed=0).state()
    previous_action = np.zeros(12)
    return _percentiles(_time_calls(lambda: network.update(state, previous_action), 5000))


def bench_packets() -> dict[str, Any]:
    """Time encoding and decoding of command and state packets, of the AlienGo and of the Go2.

    Returns:
        Medians, us; the names of the Go2's start with `go2_`.
    """
    twelve = np.full(12, 10)
    state = BoardState(make_simulator(Setup(), seed=0).state(), twelve, twelve, twelve)
    command = JointCommand(q=load_robot(DEFAULT_ROBOT).nominal_q, kp=np.full(12, 100.0), kd=np.full(12, 3.0))
    jobs: dict[str, Callable[[], object]] = {}
    for robot, packets in (("", wire), ("go2_", dds_wire)):
        of_state, of_command = packets.encode_state(state), packets.encode_command(command)
        jobs |= {
            f"{robot}encode_command": partial(packets.encode_command, command),
            f"{robot}decode_state": partial(packets.decode_state, of_state),
            f"{robot}encode_state": partial(packets.encode_state, state),
            f"{robot}decode_command": partial(packets.decode_command, of_command),
        }
    return {f"{name}_p50_us": _percentiles(_time_calls(job, 5000))["p50_us"] for name, job in jobs.items()}


class _TimedSupervisor(Supervisor):
    """Supervisor that records the duration of each tick."""

    def __init__(self, robot: Robot, policy: PolicyFile) -> None:
        super().__init__(robot, policy)
        self.seconds: list[float] = []

    @override
    def tick(self, inputs: TickInput) -> JointCommand:
        start = time.perf_counter()
        answer = super().tick(inputs)
        self.seconds.append(time.perf_counter() - start)
        self.run_deferred()
        return answer


def bench_supervisor() -> dict[str, Any]:
    """Time a supervisor tick while walking: checks, observation and inference.

    Returns:
        Median and 99th percentile, us.
    """
    chosen, robot = load_robot(DEFAULT_ROBOT), make_simulator(Setup(), seed=0)
    timed = _TimedSupervisor(chosen, PolicyFile(chosen))
    walking = RobotLoop(robot, timed, TrueVelocity(robot))
    walking.start_walking()
    timed.seconds.clear()
    for _ in range(600):
        walking.tick(WALK_COMMAND)
    return _percentiles(timed.seconds)


PARTS: dict[str, Benchmark] = {
    "simulator": Benchmark(
        bench_simulator,
        (
            ("realtime_factor", "simulator alone, times real time", "15 or more"),
            ("with_sensors_realtime_factor", "simulator with sensors at 200 Hz", ""),
        ),
    ),
    "world": Benchmark(
        bench_world,
        (
            ("realtime_factor", "simulator on the campus, times real time", ""),
            ("scan_p50_us", "scan of 1080 rays on the campus, median, us", "5000 or less"),
        ),
    ),
    "loop": Benchmark(
        bench_loop,
        (("realtime_factor", "evaluation loop, times real time", ""),),
    ),
    "policy": Benchmark(
        bench_policy,
        (
            ("p50_us", "inference, observation to action, median, us", "50 or less"),
            ("p99_us", "inference, observation to action, 99 %, us", ""),
            ("rested_p50_us", "inference after 5 ms of rest, median, us", ""),
            ("rested_idle_p50_us", "smallest network after 5 ms of rest, us", ""),
        ),
    ),
    "supervisor": Benchmark(
        bench_supervisor,
        (
            ("p50_us", "supervisor tick, median, us", ""),
            ("p99_us", "supervisor tick, 99 %, us", "1000 or less"),
        ),
    ),
    "estimator": Benchmark(
        bench_estimator,
        (("p50_us", "learned estimator, median, us", ""),),
    ),
    "packets": Benchmark(
        bench_packets,
        (
            ("encode_command_p50_us", "command to packet, median, us", "60 or less"),
            ("decode_state_p50_us", "packet to state, median, us", "60 or less"),
            ("go2_encode_command_p50_us", "the same for a Go2: command to sample", "60 or less"),
            ("go2_decode_state_p50_us", "sample to state", "60 or less"),
            ("encode_state_p50_us", "state to packet, median, us", "60 or less"),
            ("decode_command_p50_us", "packet to command, median, us", "60 or less"),
        ),
    ),
    "round_trip": Benchmark(
        round_trip.measure_round_trips,
        (
            ("p50_us", "message round trip, median, us", ""),
            ("p99_us", "message round trip, 99 %, us", ""),
        ),
    ),
}
"""Benchmarks of this package, by part."""


def all_parts() -> dict[str, Benchmark]:
    """List PARTS and the benchmarks of other packages.

    Returns:
        Benchmarks by part; one that cannot be loaded reports why it is skipped.
    """
    return PARTS | {entry.name: _load(entry) for entry in metadata.entry_points(group=GROUP)}


def live_parts(seconds: float, busy: int) -> dict[str, Benchmark]:
    """List the benchmarks of running nodes.

    Args:
        seconds: Duration of each, s.
        busy: Number of other processes that compute without a pause.

    Returns:
        Benchmarks by part.
    """
    return {entry.name: entry.load()(seconds, busy) for entry in metadata.entry_points(group=LIVE_GROUP)}


def _load(entry: metadata.EntryPoint) -> Benchmark:
    """Load the benchmark that an entry point names."""
    try:
        benchmark: Benchmark = entry.load()
    except ImportError as error:
        skipped = {
            "skipped": f"{error.name} is not installed; pip install -c requirements.lock -e '.[train]'"
        }
        return Benchmark(lambda: skipped, (("", entry.name, ""),))
    return benchmark


def benchmark_table(results: dict[str, dict[str, Any]], parts: dict[str, Benchmark]) -> Table:
    """Create a table of the figures and their targets.

    Args:
        results: Results by part.
        parts: The benchmarks.

    Returns:
        The table.
    """
    found = Table("figure", "measured", "target", title="Benchmark")
    for part, benchmark in parts.items():
        result = results[part]
        for figure, about, wanted in benchmark.rows:
            found.add_row(about, result.get("skipped") or number_text(result[figure], ",.4g"), wanted)
    return found
