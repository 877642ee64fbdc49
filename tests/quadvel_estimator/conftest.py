"""An estimator network without training, written with onnx.helper, and a robot that stands still."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

import quadvel_dds
from quadvel_description.quadruped import GRAVITY
from quadvel_description.state import RobotState
from quadvel_estimator import features
from tests.helpers.robots import ALIENGO

quadvel_dds.install()  # before a test module imports rclpy

MEMORY = (1, 1, 3)
WEIGHTS = np.random.default_rng(0).normal(size=(features.INPUT_SIZE, 3)).astype(np.float32)
VARIANCE = np.array([0.04, 0.01, 0.09])


@pytest.fixture
def standing() -> Callable[..., RobotState]:
    """standing(time, **changes): the state of a robot that stands still, changed by `changes`."""

    def state(time: float, **changes: Any) -> RobotState:
        still = RobotState(
            time=time,
            tick=round(1e3 * time),
            q=ALIENGO.nominal_q,
            dq=np.zeros(12),
            tau=np.zeros(12),
            quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
            angular_velocity=np.zeros(3),
            linear_acceleration=np.array([0.0, 0.0, GRAVITY]),
            foot_force=np.full(4, 80.0),
        )
        return attrs.evolve(still, **changes)

    return state


@pytest.fixture
def weights() -> NDArray[np.float32]:
    """(69, 3), of the network that `write_estimator` writes."""
    return WEIGHTS


@pytest.fixture
def variance() -> NDArray[np.float64]:
    """(3,), before scaling, of the network that `write_estimator` writes."""
    return VARIANCE


def write_estimator_file(
    path: Path,
    outputs: tuple[str, str] = tuple(features.OUTPUTS),
    size: int = len(WEIGHTS),
    width: int = 3,
    metadata: str | None = None,
    **changes: Any,
) -> Path:
    """velocity = obs WEIGHTS + number of steps before this one; log_variance = log VARIANCE, always.

    `metadata` replaces the JSON of a good file, `changes` replaces fields in it.
    """
    velocity, log_variance = outputs

    def tensor(name: str, *shape: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    constants = {
        "weights": np.resize(WEIGHTS, (size, width)).astype(np.float32),
        "one": np.ones(1, np.float32),
        "logs": np.resize(np.log(VARIANCE), (1, width)).astype(np.float32),
        "nothing": np.zeros((size, width), np.float32),
    }
    nodes = [
        helper.make_node("MatMul", ["obs", "weights"], ["product"]),
        helper.make_node("ReduceMax", ["h_in"], ["steps"], keepdims=0),
        helper.make_node("Add", ["product", "steps"], [velocity]),
        helper.make_node("MatMul", ["obs", "nothing"], ["zero"]),
        helper.make_node("Add", ["zero", "logs"], [log_variance]),
        helper.make_node("Add", ["h_in", "one"], ["h_out"]),
        helper.make_node("Identity", ["c_in"], ["c_out"]),
    ]
    graph = helper.make_graph(
        nodes,
        "estimator",
        [tensor("obs", 1, size), tensor("h_in", *MEMORY), tensor("c_in", *MEMORY)],
        [tensor(name, 1, width) for name in outputs] + [tensor(f"{x}_out", *MEMORY) for x in "hc"],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    good = features.metadata(
        ALIENGO,
        MEMORY,
        recipe="none",
        commit="test",
        layout=features.default_layout(ALIENGO),
        output_scale=0.5,
    )
    helper.set_model_props(model, {"quadvel": json.dumps(good | changes) if metadata is None else metadata})
    onnx.save(model, path)
    return path


@pytest.fixture
def write_estimator(tmp_path: Path) -> Callable[..., Path]:
    """write_estimator(**arguments of write_estimator_file) -> path."""
    return lambda **changes: write_estimator_file(tmp_path / "estimator.onnx", **changes)
