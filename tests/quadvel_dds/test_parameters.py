"""Parameters of a node: defaults, overrides, ranges, callbacks, services."""

from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

Start = Callable[..., None]


def test_parameter_defaults_and_overrides(ros: Start) -> None:
    ros("--ros-args", "-p", "gain:=2.5", "-p", "unknown:=1")
    node = Node("control")
    assert node.declare_parameter("gain", 1.0).value == 2.5
    assert node.declare_parameter("rate", 200, ParameterDescriptor(description="Hz")).value == 200
    assert node.describe_parameter("rate").description == "Hz"
    assert set(node._parameter_overrides) - set(node._parameters) == {"unknown"}
    with pytest.raises(ParameterAlreadyDeclaredException, match="gain"):
        node.declare_parameter("gain", 1.0)
    with pytest.raises(ParameterNotDeclaredException, match="mass"):
        node.get_parameter("mass")


def test_override_of_another_type_is_refused(ros: Start) -> None:
    ros("--ros-args", "-p", "gain:=2")
    with pytest.raises(
        InvalidParameterTypeException, match="'gain' to '2' of type 'INTEGER', expecting type 'DOUBLE'"
    ):
        Node("control").declare_parameter("gain", 1.0)


def test_parameter_with_a_type_alone_must_be_given(ros: Start) -> None:
    ros("--ros-args", "-p", "policy:=walk.onnx")
    node = Node("control")
    assert node.declare_parameter("policy", Parameter.Type.STRING).value == "walk.onnx"
    node.declare_parameter("model", Parameter.Type.STRING)
    with pytest.raises(ParameterUninitializedException, match="model"):
        node.get_parameter("model")


def test_ranges_hold_at_the_start_and_later(ros: Start) -> None:
    ros("--ros-args", "-p", "steps:=7")
    node = Node("control")
    gain = ParameterDescriptor(floating_point_range=[FloatingPointRange(from_value=0.0, to_value=2.0)])
    steps = ParameterDescriptor(integer_range=[IntegerRange(from_value=0, to_value=10, step=2)])
    node.declare_parameter("gain", 2.0, gain)
    with pytest.raises(InvalidParameterValueException, match="found 7, expected 0 to 10, step 2"):
        node.declare_parameter("steps", 4, steps)
    (result,) = node.set_parameters([Parameter("gain", value=2.5)])
    assert not result.successful
    assert "found 2.5, expected 0.0 to 2.0" in result.reason
    assert node.get_parameter("gain").value == 2.0


def test_callbacks_refuse_and_are_told(ros: Start) -> None:
    ros()
    node, told = Node("control"), []
    node.declare_parameters("limits", [("vx", 1.0), ("vy", 0.5, ParameterDescriptor(read_only=True))])

    def refuse_negative(parameters: list[Parameter]) -> Any:
        bad = [p.name for p in parameters if p.value < 0]
        return SetParametersResult(successful=not bad, reason=f"{bad} below zero")

    node.add_on_set_parameters_callback(refuse_negative)
    node.add_post_set_parameters_callback(told.append)
    assert node.set_parameters_atomically([Parameter("limits.vx", value=0.8)]).successful
    refused = node.set_parameters([Parameter("limits.vx", value=-1.0), Parameter("limits.vx", value=1)])
    assert [result.successful for result in refused] == [False, False]
    assert "below zero" in refused[0].reason
    assert "expected 'DOUBLE' got 'INTEGER'" in refused[1].reason
    assert "read-only" in node.set_parameters([Parameter("limits.vy", value=0.1)])[0].reason
    assert [[p.value for p in parameters] for parameters in told] == [[0.8]]
    assert {name: p.value for name, p in node.get_parameters_by_prefix("limits").items()} == {
        "vx": 0.8,
        "vy": 0.5,
    }


def test_pre_set_callbacks_change_what_is_set_and_removed_ones_do_not(ros: Start) -> None:
    ros()
    node = Node("control")
    node.declare_parameters("", [("vx", 1.0), ("vy", 0.5)])

    def halve(parameters: list[Parameter]) -> list[Parameter]:
        return [Parameter(p.name, value=p.value / 2) for p in parameters]

    def refuse(parameters: list[Parameter]) -> Any:
        return SetParametersResult(successful=False, reason="never")

    node.add_pre_set_parameters_callback(halve)
    node.set_parameters([Parameter("vx", value=0.8)])
    node.remove_pre_set_parameters_callback(halve)
    node.set_parameters([Parameter("vy", value=0.8)])
    assert [p.value for p in node.get_parameters(["vx", "vy"])] == [0.4, 0.8]
    node.add_on_set_parameters_callback(refuse)
    assert not node.set_parameters([Parameter("vx", value=0.1)])[0].successful
    node.remove_on_set_parameters_callback(refuse)
    assert node.set_parameters([Parameter("vx", value=0.1)])[0].successful


def test_undeclared_parameter_is_gone_and_has_an_alternative(ros: Start) -> None:
    ros()
    node, other = Node("control"), Parameter("gain", value=2.0)
    node.declare_parameter("gain", 1.0)
    assert node.get_parameter_or("gain", other).value == 1.0
    node.undeclare_parameter("gain")
    assert not node.has_parameter("gain")
    assert node.get_parameter_or("gain", other).value == 2.0
    node.declare_parameter("model", "eam", ParameterDescriptor(read_only=True))
    with pytest.raises(ParameterImmutableException, match="model"):
        node.undeclare_parameter("model")


def test_parameter_services_read_and_set(ros: Start) -> None:
    from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters

    ros()
    node = Node("control")
    node.declare_parameter("gains.kp", [30.0, 31.0])

    def call(type_: Any, name: str, request: Any) -> Any:
        future = node.create_client(type_, f"/control/{name}").call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=10.0)
        return future.result()

    listed = call(ListParameters, "list_parameters", ListParameters.Request(prefixes=["gains"])).result
    assert (listed.names, listed.prefixes) == (["gains.kp"], ["gains"])
    changed = Parameter("gains.kp", value=[25.0]).to_parameter_msg()
    assert (
        call(SetParameters, "set_parameters", SetParameters.Request(parameters=[changed]))
        .results[0]
        .successful
    )
    (value,) = call(GetParameters, "get_parameters", GetParameters.Request(names=["gains.kp"])).values
    assert list(value.double_array_value) == [25.0]
    unknown = Parameter("gains.ki", value=1.0).to_parameter_msg()
    (result,) = call(SetParameters, "set_parameters", SetParameters.Request(parameters=[unknown])).results
    assert "gains.ki" in result.reason
