"""The services through which `ros2 param` and operator tools read and set the parameters of a node."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)

from .exceptions import ParameterNotDeclaredException, ParameterUninitializedException
from .parameter import Parameter
from .qos import qos_profile_parameters


class ParameterServices:
    """Where a name is not declared, answers to requests for several hold none, as in ROS 2."""

    def __init__(self, node: Any) -> None:
        self._node = node
        for type_, name in (
            (DescribeParameters, "describe_parameters"),
            (GetParameters, "get_parameters"),
            (GetParameterTypes, "get_parameter_types"),
            (ListParameters, "list_parameters"),
            (SetParameters, "set_parameters"),
            (SetParametersAtomically, "set_parameters_atomically"),
        ):
            node.create_service(
                type_, f"~/{name}", getattr(self, f"_{name}"), qos_profile=qos_profile_parameters
            )

    def _describe_parameters(self, request: Any, response: Any) -> Any:
        response.descriptors = self._of_each(self._node.describe_parameter, request.names)
        return response

    def _get_parameters(self, request: Any, response: Any) -> Any:
        parameters = self._of_each(self._node.get_parameter, request.names)
        response.values = [parameter.get_parameter_value() for parameter in parameters]
        return response

    def _get_parameter_types(self, request: Any, response: Any) -> Any:
        response.types = self._of_each(self._node.get_parameter_type, request.names)
        return response

    def _list_parameters(self, request: Any, response: Any) -> Any:
        response.result = self._node.list_parameters(request.prefixes, request.depth)
        return response

    def _set_parameters(self, request: Any, response: Any) -> Any:
        response.results = [self._set([parameter]) for parameter in request.parameters]
        return response

    def _set_parameters_atomically(self, request: Any, response: Any) -> Any:
        response.result = self._set(request.parameters)
        return response

    def _of_each(self, get: Any, names: list[str]) -> list[Any]:
        try:
            return [get(name) for name in names]
        except (ParameterNotDeclaredException, ParameterUninitializedException):
            return []

    def _set(self, parameters: list[Any]) -> Any:
        try:
            return self._node.set_parameters_atomically([Parameter.from_parameter_msg(p) for p in parameters])
        except ParameterNotDeclaredException as error:
            return SetParametersResult(successful=False, reason=str(error))
