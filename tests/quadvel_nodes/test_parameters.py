"""The parameters of a node that runs, as an operator's tools see them through its services."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters

from quadvel_bringup import nodes

KALMAN = "estimator:\n  ros__parameters:\n    kind: kalman\n    reset_gap: 0.25\n"
Call = Callable[..., Any]


@pytest.fixture
def call(tmp_path: Path) -> Iterator[Call]:
    """Call a parameter service of an estimator that was started with a file, and one value above it."""
    file = tmp_path / "params.yaml"
    file.write_text(KALMAN)
    arguments = ["--ros-args", "--params-file", str(file), "-p", "reset_gap:=0.5"]
    process = subprocess.Popen(nodes.process_command("estimator", arguments))
    rclpy.init(args=[])
    node = rclpy.create_node("operator")

    def ask(kind: Any, service: str, **fields: Any) -> Any:
        client = node.create_client(kind, f"/estimator/{service}")
        assert client.wait_for_service(timeout_sec=60.0)
        for _ in range(10):  # a service that has not found its client yet answers into the void
            future = client.call_async(kind.Request(**fields))
            rclpy.spin_until_future_complete(node, future, timeout_sec=3.0)
            if future.done():
                return future.result()
        raise AssertionError(f"{service} does not answer")

    yield ask
    node.destroy_node()
    rclpy.shutdown()
    process.terminate()
    assert process.wait(30.0) == 0


def test_parameters_come_from_a_file_and_are_told_but_fixed(call: Call) -> None:
    listed = call(ListParameters, "list_parameters").result.names
    assert {"kind", "reset_gap", "use_sim_time"} <= {*listed}
    kind, gap = call(GetParameters, "get_parameters", names=["kind", "reset_gap"]).values
    assert (kind.string_value, gap.double_value) == ("kalman", 0.5)
    (descriptor,) = call(DescribeParameters, "describe_parameters", names=["reset_gap"]).descriptors
    assert descriptor.read_only
    assert descriptor.description
    wanted = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=0.1)
    request = [Parameter(name="reset_gap", value=wanted)]
    (refused,) = call(SetParameters, "set_parameters", parameters=request).results
    assert not refused.successful
    assert "read-only" in refused.reason
    (gap,) = call(GetParameters, "get_parameters", names=["reset_gap"]).values
    assert gap.double_value == 0.5
