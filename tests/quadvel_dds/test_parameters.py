"""Tests of a node's parameters: defaults, overrides, services."""

from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rcl_interfaces.msg import Parameter as ParameterMessage
from rclpy.exceptions import ParameterException, ParameterNotDeclaredException
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
    with pytest.raises(ParameterException, match="gain"):
        node.declare_parameter("gain", 1.0)
    with pytest.raises(ParameterNotDeclaredException, match="mass"):
        node.get_parameter("mass")


def test_override_of_another_type_is_refused(ros: Start) -> None:
    ros("--ros-args", "-p", "gain:=2")
    with pytest.raises(ParameterException, match="'gain' to '2' of type 'INTEGER', expecting type 'DOUBLE'"):
        Node("control").declare_parameter("gain", 1.0)


def test_parameter_with_a_type_alone_must_be_given(ros: Start) -> None:
    ros("--ros-args", "-p", "policy:=walk.onnx")
    node = Node("control")
    assert node.declare_parameter("policy", Parameter.Type.STRING).value == "walk.onnx"
    node.declare_parameter("model", Parameter.Type.STRING)
    with pytest.raises(ParameterException, match="model"):
        node.get_parameter("model")


def test_what_is_not_offered_of_a_parameter_is_refused(ros: Start) -> None:
    ros()
    node = Node("control")
    gain = ParameterDescriptor(floating_point_range=[FloatingPointRange(from_value=0.0, to_value=2.0)])
    with pytest.raises(UnsupportedError, match="parameter gain: option 'floating_point_range'"):
        node.declare_parameter("gain", 2.0, gain)
    with pytest.raises(UnsupportedError, match=r"Node\.add_on_set_parameters_callback"):
        node.add_on_set_parameters_callback(print)


def test_parameters_are_read_through_services_and_set_by_none(ros: Start) -> None:
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
    wanted = ParameterMessage(
        name="gains.kp", value=Parameter("gains.kp", value=[25.0]).get_parameter_value()
    )
    request = SetParameters.Request(parameters=[wanted])
    (refused,) = call(SetParameters, "set_parameters", request).results
    assert not refused.successful
    assert "read-only parameter: gains.kp" in refused.reason
    (value,) = call(GetParameters, "get_parameters", GetParameters.Request(names=["gains.kp"])).values
    assert list(value.double_array_value) == [30.0, 31.0]
    assert not call(GetParameters, "get_parameters", GetParameters.Request(names=["gains.ki"])).values
