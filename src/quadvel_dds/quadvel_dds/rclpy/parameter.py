"""Parameters of a node: a name, a type, a value."""

from __future__ import annotations

import array
from enum import Enum
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue

from quadvel_dds.errors import module_getattr

__getattr__ = module_getattr(__name__)
PARAMETER_SEPARATOR_STRING = "."

# Scalar and element types in the order in which a value is tried: a bool is an int too.
_SCALARS = {"BOOL": bool, "INTEGER": int, "DOUBLE": float, "STRING": str}
_ELEMENTS = {
    "BYTE_ARRAY": bytes,
    "BOOL_ARRAY": bool,
    "INTEGER_ARRAY": int,
    "DOUBLE_ARRAY": float,
    "STRING_ARRAY": str,
}


class Parameter:
    class Type(Enum):
        NOT_SET = ParameterType.PARAMETER_NOT_SET
        BOOL = ParameterType.PARAMETER_BOOL
        INTEGER = ParameterType.PARAMETER_INTEGER
        DOUBLE = ParameterType.PARAMETER_DOUBLE
        STRING = ParameterType.PARAMETER_STRING
        BYTE_ARRAY = ParameterType.PARAMETER_BYTE_ARRAY
        BOOL_ARRAY = ParameterType.PARAMETER_BOOL_ARRAY
        INTEGER_ARRAY = ParameterType.PARAMETER_INTEGER_ARRAY
        DOUBLE_ARRAY = ParameterType.PARAMETER_DOUBLE_ARRAY
        STRING_ARRAY = ParameterType.PARAMETER_STRING_ARRAY

        @classmethod
        def from_parameter_value(cls, parameter_value: Any) -> Parameter.Type:
            """Type of a Python value. Raises TypeError if no parameter can hold it."""
            if parameter_value is None:
                return cls.NOT_SET
            for name, scalar in _SCALARS.items():
                if isinstance(parameter_value, scalar):
                    return cls[name]
            if isinstance(parameter_value, (list, tuple, array.array)):
                for name, element in _ELEMENTS.items():
                    if all(isinstance(value, element) for value in parameter_value):
                        return cls[name]
            raise TypeError(
                f"The given value is not of a type that a parameter can hold: {parameter_value!r}"
            )

        def check(self, parameter_value: Any) -> bool:
            """Whether a value is of this type."""
            if self == Parameter.Type.NOT_SET:
                return parameter_value is None
            if self.name in _SCALARS:
                return isinstance(parameter_value, _SCALARS[self.name])
            element = _ELEMENTS[self.name]
            is_list = isinstance(parameter_value, (list, tuple, array.array))
            return is_list and all(isinstance(value, element) for value in parameter_value)

    def __init__(self, name: str, type_: Parameter.Type | None = None, value: Any = None) -> None:
        if type_ is None:
            type_ = Parameter.Type.from_parameter_value(value)
        if not isinstance(type_, Parameter.Type):
            raise TypeError(f"type must be an instance of {Parameter.Type!r}")
        if not type_.check(value):
            raise ValueError(f"Type '{type_}' and value '{value}' do not agree")
        self._name, self._type_, self._value = name, type_, value

    @property
    def name(self) -> str:
        return self._name

    @property
    def type_(self) -> Parameter.Type:
        return self._type_

    @property
    def value(self) -> Any:
        return self._value

    def get_parameter_value(self) -> Any:
        """The value as message rcl_interfaces/ParameterValue."""
        message = ParameterValue(type=self.type_.value)
        if self.type_ != Parameter.Type.NOT_SET:
            setattr(message, f"{self.type_.name.lower()}_value", self.value)
        return message

    def to_parameter_msg(self) -> Any:
        return ParameterMessage(name=self.name, value=self.get_parameter_value())

    @classmethod
    def from_parameter_msg(cls, param_msg: Any) -> Parameter:
        type_ = Parameter.Type(param_msg.value.type)
        return cls(param_msg.name, type_, parameter_value_to_python(param_msg.value))


def parameter_value_to_python(parameter_value: Any) -> Any:
    """The Python value of message rcl_interfaces/ParameterValue, None where it is not set."""
    type_ = Parameter.Type(parameter_value.type)
    if type_ == Parameter.Type.NOT_SET:
        return None
    value = getattr(parameter_value, f"{type_.name.lower()}_value")
    return list(value) if type_.name in _ELEMENTS else value
