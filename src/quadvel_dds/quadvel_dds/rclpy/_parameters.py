"""The parameters of a node: declaration, overrides, and what operators read and set. A part of `Node`."""

from __future__ import annotations

from typing import Any

from rcl_interfaces import srv
from rcl_interfaces.msg import ListParametersResult, ParameterDescriptor, ParameterEvent, SetParametersResult

from quadvel_dds.errors import Partial, refuse_options

from . import exceptions
from .parameter import Parameter
from .qos import qos_profile_parameters


class ParameterMixin(Partial):
    """Keeps `_parameters` and `_descriptors` by name.

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

        Raises ParameterAlreadyDeclaredException, InvalidParameterException on a bad name, and
        InvalidParameterTypeException on an override of another type.
        """
        if name in self._parameters:
            raise exceptions.ParameterAlreadyDeclaredException(name)
        if not name or name.startswith(".") or name.endswith("."):
            raise exceptions.InvalidParameterException(name)
        descriptor = ParameterDescriptor() if descriptor is None else descriptor
        refuse_options(
            f"parameter {name}",
            dynamic_typing=descriptor.dynamic_typing,
            integer_range=descriptor.integer_range,
            floating_point_range=descriptor.floating_point_range,
        )
        descriptor.name = name
        if isinstance(value, Parameter.Type):
            kind, value = value, None
        else:
            kind = Parameter.Type.from_parameter_value(value)
        descriptor.type = kind.value
        if not ignore_override and name in self._parameter_overrides:
            value = self._parameter_overrides[name].value
        parameter = Parameter(name, value=value)
        if value is not None and kind != Parameter.Type.NOT_SET and not kind.check(value):
            raise exceptions.InvalidParameterTypeException(parameter, kind)
        self._descriptors[name] = descriptor
        self._parameters[name] = Parameter(name)
        if value is not None:
            self._apply([parameter])
        return self._parameters[name]

    def has_parameter(self, name: str) -> bool:
        return name in self._parameters

    def get_parameter(self, name: str) -> Parameter:
        if name not in self._parameters:
            raise exceptions.ParameterNotDeclaredException(name)
        parameter = self._parameters[name]
        if parameter.type_ == Parameter.Type.NOT_SET:
            raise exceptions.ParameterUninitializedException(name)
        return parameter

    def get_parameters(self, names: list[str]) -> list[Parameter]:
        return [self.get_parameter(name) for name in names]

    def set_parameters(self, parameter_list: list[Parameter]) -> list[Any]:
        """Set parameters one by one; the results say which were refused and why."""
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> Any:
        """Set all parameters or, if one of them is refused, none. Raises ParameterNotDeclaredException."""
        for parameter in parameter_list:
            if parameter.name not in self._parameters:
                raise exceptions.ParameterNotDeclaredException(parameter.name)
            if fault := self._fault(parameter):
                return SetParametersResult(successful=False, reason=fault)
        self._apply(parameter_list)
        return SetParametersResult(successful=True)

    def _fault(self, parameter: Parameter) -> str | None:
        """Why a parameter can not be set, or None."""
        descriptor = self._descriptors[parameter.name]
        expected = Parameter.Type(descriptor.type)
        if descriptor.read_only:
            return f"Trying to set a read-only parameter: {parameter.name}."
        if not expected.check(parameter.value):
            return (
                f"Wrong parameter type, expected '{expected.name}' got '{parameter.type_.name}' "
                f"for parameter '{parameter.name}'"
            )
        return None

    def _apply(self, parameters: list[Parameter]) -> None:
        event = ParameterEvent(node=self.get_fully_qualified_name())
        for parameter in parameters:
            is_new = self._parameters[parameter.name].type_ == Parameter.Type.NOT_SET
            changes = event.new_parameters if is_new else event.changed_parameters
            changes.append(parameter.to_parameter_msg())
            self._parameters[parameter.name] = parameter
        self._on_parameters_set(parameters, event)

    # The services through which `ros2 param` and operator tools read and set them.
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
        response.results = [self._set([parameter]) for parameter in request.parameters]
        return response

    def _on_set_atomically(self, request: Any, response: Any) -> Any:
        response.result = self._set(request.parameters)
        return response

    def _set(self, parameters: list[Any]) -> Any:
        try:
            return self.set_parameters_atomically([Parameter.from_parameter_msg(p) for p in parameters])
        except exceptions.ParameterNotDeclaredException as error:
            return SetParametersResult(successful=False, reason=str(error))
