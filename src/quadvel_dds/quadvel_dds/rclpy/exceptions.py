"""Exceptions of rclpy that the embedded middleware raises."""

from __future__ import annotations

from quadvel_dds.errors import module_getattr

__getattr__ = module_getattr(__name__)


class NotInitializedException(Exception):
    """rclpy.init() was not called, or the context is shut down."""


class NameValidationException(Exception):
    """The name of a node, namespace, topic or service is invalid."""

    def __init__(self, name_type: str, name: str, error_msg: str, invalid_index: int) -> None:
        """Create the exception.

        Args:
            name_type: Kind of the name.
            name: The name.
            error_msg: Reason.
            invalid_index: Position of the first wrong character.
        """
        super().__init__(f"Invalid {name_type}: {error_msg}:\n  '{name}'\n   {' ' * invalid_index}^")


class ParameterException(Exception):
    """A parameter cannot be declared or read."""


class ParameterNotDeclaredException(ParameterException):
    """A parameter is read that is not declared."""

    def __init__(self, parameter: str) -> None:
        """Create the exception.

        Args:
            parameter: Name of the parameter.
        """
        super().__init__(f"Invalid access to undeclared parameter(s): {parameter}")
