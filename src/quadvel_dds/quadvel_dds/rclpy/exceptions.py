"""The exceptions of rclpy that are raised here."""

from __future__ import annotations

from typing import Any, ClassVar

from quadvel_dds.errors import module_getattr

__getattr__ = module_getattr(__name__)


class InvalidHandle(RuntimeError):
    """Something was used after it was destroyed."""


class NotInitializedException(Exception):
    def __init__(self, message: str | None = None) -> None:
        super().__init__("rclpy.init() has not been called." + (f" msg: {message}" if message else ""))


class NameValidationException(Exception):
    KIND: ClassVar[str]

    def __init__(self, name: str, error_msg: str, invalid_index: int) -> None:
        super().__init__(f"Invalid {self.KIND}: {error_msg}:\n  '{name}'\n   {' ' * invalid_index}^")


class InvalidNamespaceException(NameValidationException):
    KIND = "namespace"


class InvalidNodeNameException(NameValidationException):
    KIND = "node name"


class InvalidTopicNameException(NameValidationException):
    KIND = "topic name"


class InvalidServiceNameException(NameValidationException):
    KIND = "service name"


class ParameterException(Exception):
    TEXT: ClassVar[str]

    def __init__(self, parameter: str) -> None:
        super().__init__(f"{self.TEXT}: {parameter}")


class ParameterNotDeclaredException(ParameterException):
    TEXT = "Invalid access to undeclared parameter(s)"


class ParameterAlreadyDeclaredException(ParameterException):
    TEXT = "Parameter(s) already declared"


class ParameterUninitializedException(ParameterException):
    TEXT = "The parameter is not initialized"


class InvalidParameterException(ParameterException):
    TEXT = "Invalid parameter name"


class InvalidParameterTypeException(ParameterException):
    def __init__(self, desired_parameter: Any, expected_type: Any) -> None:
        self.TEXT = (  # type: ignore[misc]
            f"Trying to set parameter '{desired_parameter.name}' to '{desired_parameter.value}' of type "
            f"'{desired_parameter.type_.name}', expecting type '{expected_type.name}'"
        )
        super().__init__(desired_parameter.name)
