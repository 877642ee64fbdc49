"""The parameters of a node: declaration, overrides, and what operators read. A part of `Node`."""

from __future__ import annotations

from typing import Any

from rcl_interfaces import srv
from rcl_interfaces.msg import ListParametersResult, ParameterDescriptor, SetParametersResult

from quadvel_dds.errors import Partial, refuse_options

from .exceptions import ParameterException, ParameterNotDeclaredException
from .parameter import Parameter
from .qos import qos_profile_parameters


class ParameterMixin(Partial):
    """Keeps `_parameters` and `_descriptors` by name. Parameters are fixed once they are declared.

    `_parameter_overrides` holds what the command line and parameter files give this node, declared or not.
    """

    def _init_parameters(self, overrides: dict[str, Parameter]) -> None:
        self._parameters: dict[str, Parameter] = {}
        self._descriptors: dict[str, Any] = {}
        self._parameter_overrides = overrides

    def declare_parameter(
        self, name: str, value: Any = None, descriptor: Any = None, ignore_override: bool = False
    ) -> Parameter:
        """Declare a parameter with its default, or with its type alone if it must be overridden.

        Raises ParameterException if it is there already or is overridden by a value of another type.
        """
        if name in self._parameters:
            raise ParameterException(f"Parameter(s) already declared: {name}")
        descriptor = ParameterDescriptor() if descriptor is None else descriptor
        refuse_options(
            f"parameter {name}",
            dynamic_typing=descriptor.dynamic_typing,
            integer_range=descriptor.integer_range,
            floating_point_range=descriptor.floating_point_range,
        )
        if isinstance(value, Parameter.Type):
            kind, value = value, None
        else:
            kind = Parameter.Type.from_parameter_value(value)
        if not ignore_override and name in self._parameter_overrides:
            value = self._parameter_overrides[name].value
        if value is not None and not kind.check(value):
            found = Parameter.Type.from_parameter_value(value).name
            raise ParameterException(
                f"Trying to set parameter '{name}' to '{value}' of type '{found}', expecting type '{kind.name}'"
            )
        descriptor.name, descriptor.type = name, kind.value
        self._descriptors[name] = descriptor
        self._parameters[name] = Parameter(name, value=value)
        return self._parameters[name]

    def has_parameter(self, name: str) -> bool:
        return name in self._parameters

    def get_parameter(self, name: str) -> Parameter:
        if name not in self._parameters:
            raise ParameterNotDeclaredException(name)
        if self._parameters[name].type_ == Parameter.Type.NOT_SET:
            raise ParameterException(f"The parameter is not initialized: {name}")
        return self._parameters[name]

    # The services through which `ros2 param` and operator tools read them.
    def _start_parameter_services(self) -> None:
        for kind, name, answer in (
            (srv.DescribeParameters, "describe_parameters", self._on_describe),
            (srv.GetParameters, "get_parameters", self._on_get),
            (srv.GetParameterTypes, "get_parameter_types", self._on_types),
            (srv.ListParameters, "list_parameters", self._on_list),
            (srv.SetParameters, "set_parameters", self._on_set),
            (srv.SetParametersAtomically, "set_parameters_atomically", self._on_set_atomically),
        ):
            self.create_service(kind, f"~/{name}", answer, qos_profile=qos_profile_parameters)

    def _on_describe(self, request: Any, response: Any) -> Any:
        response.descriptors = [self._descriptors[name] for name in self._all_or_none(request.names)]
        return response

    def _on_get(self, request: Any, response: Any) -> Any:
        names = self._all_or_none(request.names)
        response.values = [self._parameters[name].get_parameter_value() for name in names]
        return response

    def _on_types(self, request: Any, response: Any) -> Any:
        response.types = [self._parameters[name].type_.value for name in self._all_or_none(request.names)]
        return response

    def _all_or_none(self, names: list[str]) -> list[str]:
        """The names, none of them if one is not declared: so answers ROS 2."""
        return names if all(name in self._parameters for name in names) else []

    def _on_list(self, request: Any, response: Any) -> Any:
        """Names below the prefixes (none: all), at most `depth` parts below (0: any), and their prefixes."""
        response.result = result = ListParametersResult()
        for name in self._parameters:
            below = [name[len(p) + 1 :] for p in request.prefixes if name.startswith(f"{p}.")]
            parts = [rest.count(".") for rest in (below if request.prefixes else [name])]
            if name in request.prefixes or any(not request.depth or n < request.depth for n in parts):
                result.names.append(name)
                prefix = name.rpartition(".")[0]
                result.prefixes += [prefix] if prefix and prefix not in result.prefixes else []
        return response

    def _on_set(self, request: Any, response: Any) -> Any:
        response.results = [self._refusal([parameter]) for parameter in request.parameters]
        return response

    def _on_set_atomically(self, request: Any, response: Any) -> Any:
        response.result = self._refusal(request.parameters)
        return response

    def _refusal(self, parameters: list[Any]) -> Any:
        names = ", ".join(parameter.name for parameter in parameters)
        return SetParametersResult(successful=False, reason=f"Trying to set a read-only parameter: {names}.")
