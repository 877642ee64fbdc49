"""A policy without training, and a ROS graph of one node under test and a peer that moves time.

The policy is a tiny LSTM written with onnx.helper, or a stub that records its inputs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

import quadvel_dds
from quadvel_nodes import publishers
from quadvel_policy.observation import PolicyMetadata, default_observation
from tests.helpers.robots import ALIENGO

quadvel_dds.install()  # before a test module imports rclpy

import rclpy  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402

HIDDEN = 8


def make_metadata(**changes: Any) -> PolicyMetadata:
    fields: dict[str, Any] = {
        "robot": "aliengo",
        "nominal_q": tuple(ALIENGO.nominal_q),
        "observation": default_observation(ALIENGO),
        "action_offset": tuple(ALIENGO.nominal_q + 0.1),
        "action_scale": 0.25,
        "kp": ALIENGO.kp,
        "kd": ALIENGO.kd,
        "command_limits": {"vx": (-1.0, 1.5), "vy": (-0.5, 0.5), "wz": (-1.0, 1.0)},
        "state_shape": (1, 1, HIDDEN),
        "commit": "test",
    }
    return PolicyMetadata(**fields | changes)


class StubPolicy:
    """Answers `action`; remembers the inputs that it saw since it was reset."""

    def __init__(self, metadata: PolicyMetadata) -> None:
        self.metadata = metadata
        self.action = np.zeros(12, np.float32)
        self.seen: list[np.ndarray] = []
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1
        self.seen = []

    def step(self, observation: np.ndarray) -> np.ndarray:
        self.seen.append(observation.copy())
        if not np.isfinite(self.action).all():
            raise FloatingPointError("stub: the network's output actions is not finite")
        return self.action.copy()


def lstm_weights(inputs: int, actions: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)

    def draw(*shape: int) -> np.ndarray:
        return rng.normal(0.0, 0.3, shape).astype(np.float32)

    return {
        "W": draw(1, 4 * HIDDEN, inputs),
        "R": draw(1, 4 * HIDDEN, HIDDEN),
        "B": draw(1, 8 * HIDDEN),
        "head": draw(HIDDEN, actions),
    }


def write_policy_file(
    path: Path,
    metadata: dict[str, str],
    inputs: int = 48,
    actions: int = 12,
    output: str = "actions",
    exponent: float = 0.0,
) -> Path:
    """One LSTM layer and a linear head with the names and the metadata of a policy file.

    The output is multiplied by exp(exponent times the greatest input): one, unless an overflow is wanted.
    """
    weights = lstm_weights(inputs, actions)
    weights |= {"axis": np.array([0]), "exponent": np.array(exponent, np.float32)}

    def tensor(name: str, *shape: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    memory = ("h_in", "c_in")
    nodes = [
        helper.make_node("Unsqueeze", ["obs", "axis"], ["x"]),
        helper.make_node(
            "LSTM", ["x", "W", "R", "B", "", *memory], ["", "h_out", "c_out"], hidden_size=HIDDEN
        ),
        helper.make_node("Squeeze", ["h_out", "axis"], ["h"]),
        helper.make_node("MatMul", ["h", "head"], ["linear"]),
        helper.make_node("ReduceMax", ["obs"], ["greatest"]),
        helper.make_node("Mul", ["greatest", "exponent"], ["power"]),
        helper.make_node("Exp", ["power"], ["factor"]),
        helper.make_node("Mul", ["linear", "factor"], [output]),
    ]
    state = (1, 1, HIDDEN)
    graph = helper.make_graph(
        nodes,
        "policy",
        [tensor("obs", 1, inputs), *(tensor(name, *state) for name in memory)],
        [tensor(output, 1, actions), tensor("h_out", *state), tensor("c_out", *state)],
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, metadata)
    onnx.save(model, path)
    return path


@pytest.fixture
def metadata() -> PolicyMetadata:
    return make_metadata()


@pytest.fixture
def make_policy() -> Callable[..., StubPolicy]:
    """make_policy(**changes of the metadata)."""
    return lambda **changes: StubPolicy(make_metadata(**changes))


@pytest.fixture
def policy(make_policy: Callable[..., StubPolicy]) -> StubPolicy:
    return make_policy()


@pytest.fixture
def write_policy(tmp_path: Path, metadata: PolicyMetadata) -> Callable[..., Path]:
    """write_policy(properties=..., **changes of write_policy_file) -> path."""

    def write(properties: dict[str, str] | None = None, **changes: Any) -> Path:
        stored = {"quadvel": metadata.to_json()} if properties is None else properties
        return write_policy_file(tmp_path / "policy.onnx", stored, **changes)

    return write


class Graph:
    """The node under test and a peer, served by one executor, on simulated time that the peer moves."""

    def __init__(self, make_node: Callable[[], Any], *arguments: str) -> None:
        rclpy.init(args=["--ros-args", "-p", "use_sim_time:=true", *arguments])
        self._executor = SingleThreadedExecutor()
        self.node = make_node()
        self.peer = rclpy.create_node("peer", use_global_arguments=False)
        for node in (self.node, self.peer):
            self._executor.add_node(node)
        self.now = 1000.0  # s
        self.diagnostics: list[Any] = []
        self._clock = self.peer.create_publisher(Clock, "/clock", 10)
        self.diagnostics = self.listen(DiagnosticArray, "/diagnostics")
        self.wait(self._clock.get_subscription_count)

    def listen(self, kind: Any, topic: str) -> list[Any]:
        """The list of what arrives on a topic from now on."""
        heard: list[Any] = []
        self.peer.create_subscription(kind, topic, heard.append, 100)
        self.wait(lambda: self.peer.count_publishers(topic))
        return heard

    def speak(self, kind: Any, topic: str) -> Any:
        """A publisher that the node already hears."""
        publisher = self.peer.create_publisher(kind, topic, 10)
        self.wait(publisher.get_subscription_count)
        return publisher

    def call(self, kind: Any, service: str, **fields: Any) -> Any:
        """A service's response."""
        client = self.peer.create_client(kind, service)
        self.wait(client.service_is_ready)
        future = client.call_async(kind.Request(**fields))
        self.wait(future.done)
        return future.result()

    def holds(self, is_so: Callable[[], Any], seconds: float) -> bool:
        """Serve until the predicate holds; whether it does before the time is up."""
        end = time.monotonic() + seconds
        while not is_so():
            if time.monotonic() > end:
                return False
            self._executor.spin_once(timeout_sec=0.02)
        return True

    def wait(self, is_so: Callable[[], Any]) -> None:
        """Serve until the predicate holds; fail where that takes too long."""
        assert self.holds(is_so, 30.0), f"waited in vain; /diagnostics: {self.diagnostics[-1:]}"

    def pass_time(self, seconds: float) -> None:
        """Move the clock on; returns once the node has it."""
        self.now += seconds
        self._clock.publish(Clock(clock=self.stamp()))
        self.wait(lambda: abs(1e-9 * self.node.get_clock().now().nanoseconds - self.now) < 1e-6)

    def stamp(self, ahead: float = 0.0) -> Any:
        """The time in `ahead` s as a message."""
        message = Clock().clock
        nanoseconds = round(1e9 * (self.now + ahead))
        message.sec, message.nanosec = nanoseconds // 10**9, nanoseconds % 10**9
        return message

    def diagnosed(self, text: str) -> Any:
        """Wait until the node's /diagnostics contains `text` in its message or a value; return that status."""

        def matching_status() -> Any:
            for status in (status for array in self.diagnostics for status in array.status):
                texts = [status.message, *(f"{pair.key}: {pair.value}" for pair in status.values)]
                if any(text in line for line in texts):
                    return status
            return None

        self.wait(matching_status)
        return matching_status()

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self.peer.destroy_node()
        rclpy.shutdown()


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Graph]]:
    """graph(NodeClass, *ROS arguments) -> Graph; the node does not wait for others, as it is the first."""
    graphs: list[Graph] = []

    def start(make_node: Callable[[], Any], *arguments: str) -> Graph:
        with monkeypatch.context() as alone:
            alone.setattr(publishers, "DISCOVERY_TIME_S", 0.0)
            graphs.append(Graph(make_node, *arguments))
        return graphs[-1]

    yield start
    for graph in graphs:
        graph.close()
    rclpy.try_shutdown()
