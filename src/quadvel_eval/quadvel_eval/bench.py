"""How fast this machine runs the parts: what `quadvel bench` measures. Figures for people, no test of anything.

Everything is measured in one run, so that ratios hold where absolute figures vary between machines. Times are
medians: what the machine takes away now and then for others is not the part's.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from importlib import metadata, util
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike
from onnx import TensorProto, helper
from rich.table import Table

from quadvel_description.robot import NOMINAL_Q
from quadvel_description.state import JointCommand, RobotState
from quadvel_driver import wire
from quadvel_estimator.learned import LearnedEstimator
from quadvel_nodes.number_text import number_text
from quadvel_policy.policy_file import PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_sim import Simulator, SimulatorConfig, World

from . import round_trip
from .robot_loop import PERIOD, STEPS, RobotLoop, TrueVelocity
from .walk import Setup, make_loop, make_simulator

WALK = (0.5, 0.0, 0.0)
SCHEMA = 1


def machine() -> dict[str, Any]:
    """What the figures belong to."""
    packages = {name: metadata.version(name) for name in ("mujoco", "numpy", "onnxruntime")}
    return {"cores": len(os.sched_getaffinity(0)), "python": platform.python_version(), **packages}


def _percentiles(seconds: list[float]) -> dict[str, float]:
    p50, p99 = 1e6 * np.quantile(seconds, (0.5, 0.99))
    return {"p50_us": float(p50), "p99_us": float(p99)}


def _time(job: Callable[[], object], count: int, before: Callable[[], object] = lambda: None) -> list[float]:
    """Seconds of each of `count` calls, after some to warm up; not counted is what is done `before` each of them."""
    times = []
    for _ in range(count + count // 10):
        before()
        start = time.perf_counter()
        job()
        times.append(time.perf_counter() - start)
    return times[-count:]


def simulator() -> dict[str, Any]:
    """One robot that stands, a command every 5 ms; alone, and with its sensors read at 200 Hz."""
    robot = make_simulator(Setup(), seed=0)
    command = JointCommand(q=NOMINAL_Q.copy(), kp=np.full(12, 100.0), kd=np.full(12, 3.0))

    def step() -> None:
        robot.command(command)
        robot.step(STEPS)

    def step_and_read() -> None:
        step()
        robot.state()

    alone, read = _time(step, 2000), _time(step_and_read, 2000)
    return {
        "realtime_factor": PERIOD / float(np.median(alone)),
        "with_sensors_realtime_factor": PERIOD / float(np.median(read)),
    }


def world() -> dict[str, Any]:
    """The same robot on the campus; and a scan of its laser there."""
    campus = World.load("campus")
    robot = Simulator(SimulatorConfig(world=campus))
    robot.reset("stand")
    command = JointCommand(q=NOMINAL_Q.copy(), kp=np.full(12, 100.0), kd=np.full(12, 3.0))

    def step() -> None:
        robot.command(command)
        robot.step(STEPS)

    stepping, scanning = _time(step, 1000), _time(robot.scan, 50, lambda: robot.step(campus.laser.period))
    return {
        "realtime_factor": PERIOD / float(np.median(stepping)),
        "scan_p50_us": _percentiles(scanning)["p50_us"],
    }


def loop() -> dict[str, Any]:
    """The evaluation's whole loop, both estimators included, while walking."""
    walking = make_loop(Setup(), seed=0)
    times = _time(lambda: walking.tick(WALK), 600)
    return {"realtime_factor": PERIOD / float(np.median(times))}


def policy() -> dict[str, Any]:
    """Inference alone: from observation to action with the rest done ahead, as the controller runs it; and in one piece.

    Rested: as in the controller, which sleeps until the next state. Meanwhile the caches go to others; what this costs
    anybody here shows a network that does nothing.
    """
    network = PolicyFile()
    observation = np.zeros(network.metadata.observation.size, np.float32)
    idle = _idle_network()

    def step() -> None:
        network.step(observation)

    def rest() -> None:
        network.prepare()
        time.sleep(PERIOD)

    medians = {
        "ahead_p50_us": _time(network.prepare, 5000),
        "whole_p50_us": _time(step, 5000),
        "rested_p50_us": _time(step, 400, rest),
        "rested_idle_p50_us": _time(idle, 400, rest),
    }
    prepared = _percentiles(_time(step, 5000, network.prepare))
    return prepared | {name: _percentiles(times)["p50_us"] for name, times in medians.items()}


def _idle_network() -> Callable[[], object]:
    """A run of the smallest network there is: one number, handed on."""
    number = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1])
    same = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1])
    graph = helper.make_graph([helper.make_node("Identity", ["x"], ["y"])], "idle", [number], [same])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    x = {"x": np.zeros(1, np.float32)}
    return lambda: session.run(None, x)


def estimator() -> dict[str, Any]:
    """The learned estimator from state to velocity."""
    network, state = LearnedEstimator(), make_simulator(Setup(), seed=0).state()
    previous_action = np.zeros(12)
    return _percentiles(_time(lambda: network.update(state, previous_action), 5000))


def packets() -> dict[str, Any]:
    """The robot's packets: a command to bytes and a state from bytes, as the driver does it, and the other way round."""
    twelve = np.full(12, 10)
    state = wire.BoardState(make_simulator(Setup(), seed=0).state(), twelve, twelve, twelve)
    command = JointCommand(q=NOMINAL_Q.copy(), kp=np.full(12, 100.0), kd=np.full(12, 3.0))
    of_state, of_command = wire.encode_state(state), wire.encode_command(command)
    jobs: dict[str, Callable[[], object]] = {
        "encode_command": lambda: wire.encode_command(command),
        "decode_state": lambda: wire.decode_state(of_state),
        "encode_state": lambda: wire.encode_state(state),
        "decode_command": lambda: wire.decode_command(of_command),
    }
    return {f"{name}_p50_us": _percentiles(_time(job, 5000))["p50_us"] for name, job in jobs.items()}


class _TimedSupervisor(Supervisor):
    """Notes what each of its ticks takes."""

    def __init__(self, policy: PolicyFile) -> None:
        super().__init__(policy)
        self.seconds: list[float] = []

    def tick(
        self, now: float, state: RobotState, velocity: ArrayLike | None, command: ArrayLike | None
    ) -> JointCommand:
        """As the supervisor's, and between two ticks what the controller does there."""
        start = time.perf_counter()
        answer = super().tick(now, state, velocity, command)
        self.seconds.append(time.perf_counter() - start)
        self.prepare()
        return answer


def supervisor() -> dict[str, Any]:
    """A tick from state to command: all checks, observation and inference, while walking."""
    robot, timed = make_simulator(Setup(), seed=0), _TimedSupervisor(PolicyFile())
    walking = RobotLoop(robot, timed, TrueVelocity(robot))
    walking.start_walking()
    timed.seconds.clear()
    for _ in range(600):
        walking.tick(WALK)
    return _percentiles(timed.seconds)


def _training(part: str) -> Callable[[], dict[str, Any]]:
    def measure() -> dict[str, Any]:
        if util.find_spec("torch") is None:
            return {"skipped": "torch is not installed; pip install -e '.[train]'"}
        from quadvel_training import bench

        figures: dict[str, Any] = getattr(bench, part)()
        return figures

    return measure


PARTS: dict[str, Callable[[], dict[str, Any]]] = {
    "simulator": simulator,
    "world": world,
    "loop": loop,
    "policy": policy,
    "estimator": estimator,
    "supervisor": supervisor,
    "packets": packets,
    "round_trip": round_trip.measure,
    "environment": _training("environment"),
    "training": _training("training"),
}
ROWS = (  # part, figure, what it is, what is wanted
    ("simulator", "realtime_factor", "simulator alone, times real time", "15 or more"),
    ("simulator", "with_sensors_realtime_factor", "simulator with sensors at 200 Hz", ""),
    ("world", "realtime_factor", "simulator on the campus, times real time", ""),
    ("world", "scan_p50_us", "a scan of 1080 rays there, median, us", "5000 or less"),
    ("loop", "realtime_factor", "evaluation loop, times real time", ""),
    ("policy", "p50_us", "inference, observation to action, median, us", "50 or less"),
    ("policy", "p99_us", "inference, observation to action, 99 %, us", ""),
    ("policy", "ahead_p50_us", "inference, part done ahead, median, us", ""),
    ("policy", "whole_p50_us", "inference, step in one piece, median, us", ""),
    ("policy", "rested_p50_us", "inference after 5 ms of rest, median, us", ""),
    ("policy", "rested_idle_p50_us", "a network that does nothing after 5 ms of rest, us", ""),
    ("supervisor", "p50_us", "supervisor tick, median, us", ""),
    ("supervisor", "p99_us", "supervisor tick, 99 %, us", "1000 or less"),
    ("estimator", "p50_us", "learned estimator, median, us", ""),
    ("packets", "encode_command_p50_us", "command to packet, median, us", "60 or less"),
    ("packets", "decode_state_p50_us", "packet to state, median, us", "60 or less"),
    ("packets", "encode_state_p50_us", "state to packet, median, us", "60 or less"),
    ("packets", "decode_command_p50_us", "packet to command, median, us", "60 or less"),
    ("round_trip", "p50_us", "message there and back, median, us", ""),
    ("round_trip", "p99_us", "message there and back, 99 %, us", ""),
    ("environment", "steps_per_s", "training environment, steps/s", ""),
    ("environment", "ratio", "of the bare batch's", "0.7 or more"),
    ("training", "samples_per_s", "training, policy samples/s", ""),
    ("training", "ratio", "of what bare steps and passes allow", "0.6 or more"),
    ("training", "physics_share", "of its time: physics and actuators", ""),
    ("training", "sensing_share", "observations and rewards", ""),
    ("training", "inference_share", "inference", ""),
    ("training", "learning_share", "learning", ""),
)


def table(results: dict[str, dict[str, Any]]) -> Table:
    """The figures and what is wanted of them."""
    found = Table("figure", "measured", "wanted", title="Benchmark")
    for part, figure, about, wanted in ROWS:
        result = results[part]
        found.add_row(about, result.get("skipped") or number_text(result[figure], ",.4g"), wanted)
    return found
