"""The parameters of a node: declaration, overrides, validation, callbacks. A part of `Node`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

from rcl_interfaces.msg import ListParametersResult, ParameterDescriptor, ParameterEvent, SetParametersResult

from quadvel_dds.errors import unsupported

from .exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from .parameter import PARAMETER_SEPARATOR_STRING, Parameter

OnSet = Callable[[list[Parameter]], Any]
PreSet = Callable[[list[Parameter]], list[Parameter]]
PostSet = Callable[[list[Parameter]], None]


class ParameterMixin:
    """Keeps `_parameters` and `_descriptors` by name.

    `_parameter_overrides` holds what the command line and parameter files give this node, declared or not.
    """

    PARAM_REL_TOL = 1e-6

    def _init_parameters(self, overrides: dict[str, Parameter], allow_undeclared: bool) -> None:
        self._parameters: dict[str, Parameter] = {}
        self._descriptors: dict[str, Any] = {}
        self._parameter_overrides = overrides
        self._allow_undeclared_parameters = allow_undeclared
        self._pre_set_parameters_callbacks: list[PreSet] = []
        self._on_set_parameters_callbacks: list[OnSet] = []
        self._post_set_parameters_callbacks: list[PostSet] = []

    def declare_parameter(
        self, name: str, value: Any = None, descriptor: Any = None, ignore_override: bool = False
    ) -> Parameter:
        """Declare a parameter with its default, or with its type alone if it must be overridden.

        Raises ParameterAlreadyDeclaredException, InvalidParameterException on a bad name,
        InvalidParameterTypeException on an override of another type, and InvalidParameterValueException if
        the value is out of range or refused by a callback.
        """
        if name in self._parameters:
            raise ParameterAlreadyDeclaredException(name)
        if (
            not name
            or name.startswith(PARAMETER_SEPARATOR_STRING)
            or name.endswith(PARAMETER_SEPARATOR_STRING)
        ):
            raise InvalidParameterException(name)
        descriptor = ParameterDescriptor() if descriptor is None else descriptor
        descriptor.name = name
        if isinstance(value, Parameter.Type):
            descriptor.type, value = value.value, None
        elif not descriptor.dynamic_typing:
            descriptor.type = Parameter.Type.from_parameter_value(value).value
        if not ignore_override and name in self._parameter_overrides:
            value = self._parameter_overrides[name].value
        parameter = Parameter(name, value=value)
        self._descriptors[name] = descriptor
        try:
            if parameter.type_ != Parameter.Type.NOT_SET:
                self._require_valid(parameter)
            self._parameters[name] = Parameter(name)
            if value is not None:
                self._apply([parameter])
        except Exception:
            self._descriptors.pop(name)
            self._parameters.pop(name, None)
            raise
        return self._parameters[name]

    def _require_valid(self, parameter: Parameter) -> None:
        expected = Parameter.Type(self._descriptors[parameter.name].type)
        dynamic = self._descriptors[parameter.name].dynamic_typing
        fits = parameter.type_ == expected or _is_empty_list(parameter, expected)
        if not dynamic and not fits and expected != Parameter.Type.NOT_SET:
            raise InvalidParameterTypeException(parameter, expected)
        reason = range_fault(self._descriptors[parameter.name], parameter) or self._refusal([parameter])
        if reason is not None:
            raise InvalidParameterValueException(parameter.name, parameter.value, reason)

    def declare_parameters(
        self, namespace: str, parameters: list[tuple[Any, ...]], ignore_override: bool = False
    ) -> list[Parameter]:
        """Declare (name), (name, type or value) or (name, value, descriptor), each below `namespace`."""
        prefix = f"{namespace}{PARAMETER_SEPARATOR_STRING}" if namespace else ""
        declared = []
        for name, *rest in parameters:
            value, descriptor = (*rest, None, None)[:2]
            declared.append(self.declare_parameter(f"{prefix}{name}", value, descriptor, ignore_override))
        return declared

    def undeclare_parameter(self, name: str) -> None:
        self._require_declared(name)
        if self._descriptors[name].read_only:
            raise ParameterImmutableException(name)
        del self._parameters[name], self._descriptors[name]

    def has_parameter(self, name: str) -> bool:
        return name in self._parameters

    def _require_declared(self, name: str) -> None:
        if name not in self._parameters:
            raise ParameterNotDeclaredException(name)

    def get_parameter(self, name: str) -> Parameter:
        if name not in self._parameters and self._allow_undeclared_parameters:
            return Parameter(name, Parameter.Type.NOT_SET)
        self._require_declared(name)
        parameter = self._parameters[name]
        if parameter.type_ == Parameter.Type.NOT_SET and not self._descriptors[name].dynamic_typing:
            raise ParameterUninitializedException(name)
        return parameter

    def get_parameter_or(self, name: str, alternative_value: Parameter | None = None) -> Parameter:
        parameter = self._parameters.get(name)
        if parameter is None or parameter.type_ == Parameter.Type.NOT_SET:
            return alternative_value or Parameter(name, Parameter.Type.NOT_SET)
        return parameter

    def get_parameters(self, names: list[str]) -> list[Parameter]:
        return [self.get_parameter(name) for name in names]

    def get_parameter_type(self, name: str) -> Any:
        if name not in self._parameters and self._allow_undeclared_parameters:
            return Parameter.Type.NOT_SET
        self._require_declared(name)
        return self._parameters[name].type_.value

    def get_parameter_types(self, names: list[str]) -> list[Any]:
        return [self.get_parameter_type(name) for name in names]

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Parameter]:
        start = f"{prefix}{PARAMETER_SEPARATOR_STRING}" if prefix else ""
        return {name[len(start) :]: p for name, p in self._parameters.items() if name.startswith(start)}

    def describe_parameter(self, name: str) -> Any:
        if name not in self._descriptors and self._allow_undeclared_parameters:
            return ParameterDescriptor()
        self._require_declared(name)
        return self._descriptors[name]

    def describe_parameters(self, names: list[str]) -> list[Any]:
        return [self.describe_parameter(name) for name in names]

    def list_parameters(self, prefixes: list[str], depth: int) -> Any:
        """Names below `prefixes` (none: all), at most `depth` parts below (0: any), and their prefixes."""
        result = ListParametersResult()
        for name in self._parameters:
            below = [
                name,
                *(
                    name[len(p) + 1 :]
                    for p in prefixes
                    if name.startswith(f"{p}{PARAMETER_SEPARATOR_STRING}")
                ),
            ]
            candidates = below[1:] if prefixes else below
            is_near = any(not depth or n.count(PARAMETER_SEPARATOR_STRING) < depth for n in candidates)
            if is_near or name in prefixes:
                result.names.append(name)
                prefix = name.rpartition(PARAMETER_SEPARATOR_STRING)[0]
                if prefix and prefix not in result.prefixes:
                    result.prefixes.append(prefix)
        return result

    def set_parameters(self, parameter_list: list[Parameter]) -> list[Any]:
        """Set parameters one by one; the results say which were refused and why."""
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> Any:
        """Set all parameters or, if one of them is refused, none. Raises ParameterNotDeclaredException."""
        if self._pre_set_parameters_callbacks:
            parameter_list = [
                p for callback in self._pre_set_parameters_callbacks for p in callback(parameter_list)
            ]
            if not parameter_list:
                return SetParametersResult(
                    successful=False, reason="the pre-set callbacks left no parameter to set"
                )
        for parameter in parameter_list:
            if not self._allow_undeclared_parameters:
                self._require_declared(parameter.name)
        for reason in self._faults(parameter_list):
            return SetParametersResult(successful=False, reason=reason)
        self._apply(parameter_list)
        return SetParametersResult(successful=True)

    def _faults(self, parameters: list[Parameter]) -> Iterator[str]:
        for parameter in parameters:
            descriptor = self._descriptors.get(parameter.name)
            if descriptor is None:
                continue
            expected = Parameter.Type(descriptor.type)
            if descriptor.read_only:
                yield f"Trying to set a read-only parameter: {parameter.name}."
            elif (
                not descriptor.dynamic_typing
                and parameter.type_ != expected
                and not _is_empty_list(parameter, expected)
            ):
                yield (
                    f"Wrong parameter type, expected '{expected.name}' got '{parameter.type_.name}' "
                    f"for parameter '{parameter.name}'"
                )
            elif reason := range_fault(descriptor, parameter):
                yield reason
        if (reason := self._refusal(parameters)) is not None:
            yield reason

    def _refusal(self, parameters: list[Parameter]) -> str | None:
        """The reason of the first callback that refuses."""
        for callback in self._on_set_parameters_callbacks:
            result = callback(parameters)
            if not result.successful:
                return str(result.reason)
        return None

    def _apply(self, parameters: list[Parameter]) -> None:
        event = ParameterEvent(node=self.get_fully_qualified_name())  # type: ignore[attr-defined]
        for parameter in parameters:
            known = self._parameters.get(parameter.name)
            is_new = known is None or known.type_ == Parameter.Type.NOT_SET
            changes = event.new_parameters if is_new else event.changed_parameters
            changes.append(parameter.to_parameter_msg())
            self._parameters[parameter.name] = parameter
            self._descriptors.setdefault(
                parameter.name, ParameterDescriptor(name=parameter.name, dynamic_typing=True)
            )
        self._publish_parameter_event(event)  # type: ignore[attr-defined]
        for callback in self._post_set_parameters_callbacks:
            callback(parameters)

    def add_pre_set_parameters_callback(self, callback: PreSet) -> None:
        self._pre_set_parameters_callbacks.insert(0, callback)

    def add_on_set_parameters_callback(self, callback: OnSet) -> None:
        self._on_set_parameters_callbacks.insert(0, callback)

    def add_post_set_parameters_callback(self, callback: PostSet) -> None:
        self._post_set_parameters_callbacks.insert(0, callback)

    def remove_pre_set_parameters_callback(self, callback: PreSet) -> None:
        self._pre_set_parameters_callbacks.remove(callback)

    def remove_on_set_parameters_callback(self, callback: OnSet) -> None:
        self._on_set_parameters_callbacks.remove(callback)

    def remove_post_set_parameters_callback(self, callback: PostSet) -> None:
        self._post_set_parameters_callbacks.remove(callback)

    set_descriptor = unsupported("Node.set_descriptor")


def _is_empty_list(parameter: Parameter, expected: Parameter.Type) -> bool:
    """An empty list tells no type: it fits every kind of list."""
    return expected.name.endswith("ARRAY") and parameter.value in ([], ())


def range_fault(descriptor: Any, parameter: Parameter) -> str | None:
    """What is wrong with a number (or a number of a list) as to the range of its descriptor, or None."""
    is_integer = parameter.type_ in (Parameter.Type.INTEGER, Parameter.Type.INTEGER_ARRAY)
    ranges = descriptor.integer_range if is_integer else descriptor.floating_point_range
    is_number = is_integer or parameter.type_ in (Parameter.Type.DOUBLE, Parameter.Type.DOUBLE_ARRAY)
    if not ranges or not is_number:
        return None
    bounds = ranges[0]
    values = parameter.value if parameter.type_.name.endswith("ARRAY") else [parameter.value]
    for value in values:
        if not _is_in_range(value, bounds):
            step = f", step {bounds.step}" if bounds.step else ""
            return (
                f"Parameter '{parameter.name}' is out of range: found {value}, "
                f"expected {bounds.from_value} to {bounds.to_value}{step}"
            )
    return None


def _is_in_range(value: float, bounds: Any) -> bool:
    def close(a: float, b: float) -> bool:
        return math.isclose(a, b, rel_tol=ParameterMixin.PARAM_REL_TOL)

    if close(value, bounds.from_value) or close(value, bounds.to_value):
        return True
    if not bounds.from_value <= value <= bounds.to_value:
        return False
    steps = (value - bounds.from_value) / bounds.step if bounds.step else 0.0
    return close(steps, round(steps))
