"""Parameters of a node: defaults, overrides, ranges, callbacks, services."""

from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.exceptions import (
    InvalidParameterTypeException,
    ParameterAlreadyDeclaredException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from quadvel_dds import UnsupportedError

Start = Callable[..., None]


def test_parameter_defaults_and_overrides(ros: Start) -> None:
    ros("--ros-args", "-p", "gain:=2.5", "-p", "unknown:=1")
    node = Node("control")
    assert node.declare_parameter("gain", 1.0).value == 2.5
    assert node.declare_parameter("rate", 200, ParameterDescriptor(description="Hz")).value == 200
    assert node._descriptors["rate"].description == "Hz"
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


def test_what_is_not_offered_of_a_parameter_is_refused(ros: Start) -> None:
    ros()
    node = Node("control")
    gain = ParameterDescriptor(floating_point_range=[FloatingPointRange(from_value=0.0, to_value=2.0)])
    with pytest.raises(UnsupportedError, match="parameter gain: option 'floating_point_range'"):
        node.declare_parameter("gain", 2.0, gain)
    with pytest.raises(UnsupportedError, match=r"Node\.add_on_set_parameters_callback"):
        node.add_on_set_parameters_callback(print)


def test_a_parameter_is_set_if_its_type_fits_and_it_is_not_fixed(ros: Start) -> None:
    ros()
    node = Node("control")
    node.declare_parameter("vx", 1.0)
    node.declare_parameter("vy", 0.5, ParameterDescriptor(read_only=True))
    assert node.set_parameters_atomically([Parameter("vx", value=0.8)]).successful
    (refused,) = node.set_parameters([Parameter("vx", value=1)])
    assert "expected 'DOUBLE' got 'INTEGER'" in refused.reason
    assert "read-only" in node.set_parameters([Parameter("vy", value=0.1)])[0].reason
    assert [p.value for p in node.get_parameters(["vx", "vy"])] == [0.8, 0.5]


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
