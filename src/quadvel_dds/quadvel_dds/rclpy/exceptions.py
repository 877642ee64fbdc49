"""The exceptions of rclpy that are raised here."""

from __future__ import annotations

from quadvel_dds.errors import module_getattr

__getattr__ = module_getattr(__name__)


class NotInitializedException(Exception):
    """There is no rclpy.init() before, or a shutdown after it."""


class NameValidationException(Exception):
    def __init__(self, name_type: str, name: str, error_msg: str, invalid_index: int) -> None:
        super().__init__(f"Invalid {name_type}: {error_msg}:\n  '{name}'\n   {' ' * invalid_index}^")


class ParameterException(Exception):
    """A parameter cannot be declared or read, in a sentence."""


class ParameterNotDeclaredException(ParameterException):
    def __init__(self, parameter: str) -> None:
        super().__init__(f"Invalid access to undeclared parameter(s): {parameter}")
