"""Parameters of a node: name, type and value."""

from __future__ import annotations

from enum import Enum
from typing import Any

from rcl_interfaces.msg import ParameterType, ParameterValue

from quadvel_dds.errors import Partial, module_getattr

__getattr__ = module_getattr(__name__)
# What a value of each type is made of, in the order in which types are tried: a bool is an int too.
_ELEMENTS = {"BOOL": bool, "INTEGER": int, "DOUBLE": float, "STRING": str}


class ParameterKind(Enum):
    """Type of a parameter; rclpy's `Parameter.Type`."""

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
    def from_parameter_value(cls, parameter_value: Any) -> ParameterKind:
        """Find the type of a Python value.

        Args:
            parameter_value: The value.

        Returns:
            Type of a parameter that holds it.

        Raises:
            TypeError: No parameter can hold it.
        """
        for member in cls:
            if member.check(parameter_value):
                return member
        raise TypeError(f"The given value is not of a type that a parameter can hold: {parameter_value!r}")

    def check(self, parameter_value: Any) -> bool:
        """Return whether a value has this type; an empty list has every list type.

        Args:
            parameter_value: The value.

        Returns:
            Whether it has this type.
        """
        if self == ParameterKind.NOT_SET:
            return parameter_value is None
        if self.name in _ELEMENTS:
            is_number = not isinstance(parameter_value, bool) or self == ParameterKind.BOOL
            return isinstance(parameter_value, _ELEMENTS[self.name]) and is_number
        element = _ELEMENTS.get(self.name.removesuffix("_ARRAY"), bytes)
        is_list = isinstance(parameter_value, (list, tuple))
        return is_list and all(isinstance(value, element) for value in parameter_value)


class Parameter(Partial):
    """Parameter, see rclpy's Parameter.

    Attributes:
        name: Name of the parameter.
        value: Its value.
        type_: Its type.
    """

    Type = ParameterKind

    def __init__(self, name: str, type_: ParameterKind | None = None, value: Any = None) -> None:
        """Create a parameter.

        Args:
            name: Name of the parameter.
            type_: Its type; None: that of the value.
            value: Its value.

        Raises:
            ValueError: Type and value do not match.
        """
        self.name, self.value = name, value
        self.type_ = ParameterKind.from_parameter_value(value) if type_ is None else type_
        if not self.type_.check(value):
            raise ValueError(f"Type '{type_}' and value '{value}' do not agree")

    def get_parameter_value(self) -> Any:
        """Convert the value to a message.

        Returns:
            A rcl_interfaces/ParameterValue.
        """
        message = ParameterValue(type=self.type_.value)
        if self.type_ != ParameterKind.NOT_SET:
            setattr(message, f"{self.type_.name.lower()}_value", self.value)
        return message
