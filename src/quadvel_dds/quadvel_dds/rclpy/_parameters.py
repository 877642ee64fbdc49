"""Parameters of a node: declaration, overrides, and services. A base class of `Node`."""

from __future__ import annotations

from typing import Any

from rcl_interfaces import srv
from rcl_interfaces.msg import ListParametersResult, ParameterDescriptor, SetParametersResult

from quadvel_dds.errors import Partial, refuse_options

from .exceptions import ParameterException, ParameterNotDeclaredException
from .parameter import Parameter
from .qos import qos_profile_parameters


class ParameterMixin(Partial):
    """Parameters of a node; they are constant once they are declared.

    `_parameters` and `_descriptors` hold the declared ones by name. `_parameter_overrides` holds
    the values from command line and parameter files, declared or not.
    """

    def _init_parameters(self, overrides: dict[str, Parameter]) -> None:
        """Start without declared parameters."""
        self._parameters: dict[str, Parameter] = {}
        self._descriptors: dict[str, Any] = {}
        self._parameter_overrides = overrides

    def declare_parameter(
        self, name: str, value: Any = None, descriptor: Any = None, ignore_override: bool = False
    ) -> Parameter:
        """Declare a parameter.

        Args:
            name: Name of the parameter.
            value: Default, or a `Parameter.Type` if an override is required.
            descriptor: Description, a rcl_interfaces/ParameterDescriptor.
            ignore_override: Whether an override is ignored.

        Returns:
            The parameter.

        Raises:
            ParameterException: It is declared already, or the override has another type.
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
        """Return whether a parameter is declared.

        Args:
            name: Name of the parameter.

        Returns:
            Whether it is declared.
        """
        return name in self._parameters

    def get_parameter(self, name: str) -> Parameter:
        """Return a declared parameter.

        Args:
            name: Name of the parameter.

        Returns:
            The parameter.

        Raises:
            ParameterNotDeclaredException: It is not declared.
            ParameterException: It has no value.
        """
        if name not in self._parameters:
            raise ParameterNotDeclaredException(name)
        if self._parameters[name].type_ == Parameter.Type.NOT_SET:
            raise ParameterException(f"The parameter is not initialized: {name}")
        return self._parameters[name]

    # The services through which `ros2 param` and operator tools read them.
    def _start_parameter_services(self) -> None:
        """Create the parameter services."""
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
        """Return the names if all are declared, else none, as ROS 2 answers."""
        return names if all(name in self._parameters for name in names) else []

    def _on_list(self, request: Any, response: Any) -> Any:
        """List the names below given prefixes, at most `depth` parts below; [] and 0 mean all."""
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
        """Return the result of a refused change."""
        names = ", ".join(parameter.name for parameter in parameters)
        return SetParametersResult(successful=False, reason=f"Trying to set a read-only parameter: {names}.")
