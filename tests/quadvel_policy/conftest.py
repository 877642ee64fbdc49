"""A policy without training: a tiny LSTM written with onnx.helper, and a stub that says what it was asked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from quadvel_description.robot import KD, KP, NOMINAL_Q
from quadvel_policy.observation import PolicyMetadata

HIDDEN = 8


def make_metadata(**changes: Any) -> PolicyMetadata:
    fields: dict[str, Any] = {
        "action_offset": tuple(NOMINAL_Q + 0.1),
        "action_scale": 0.25,
        "kp": KP,
        "kd": KD,
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
