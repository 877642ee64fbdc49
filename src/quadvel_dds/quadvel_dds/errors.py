"""Errors for the parts of rclpy that the embedded middleware does not support."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn


class UnsupportedError(NotImplementedError):
    """A part of rclpy that the embedded middleware does not support."""

    def __init__(self, what: str) -> None:
        """Create the error.

        Args:
            what: The unsupported part.
        """
        super().__init__(
            f"{what} is not offered by quadvel's embedded middleware (quadvel_dds); use ROS 2 for it"
        )


class UnsupportedModuleError(UnsupportedError, ImportError):
    """An unsupported module of rclpy; an ImportError, so that optional imports work."""


class UnsupportedMemberError(UnsupportedError, AttributeError):
    """An unsupported method or property; an AttributeError, so that `hasattr` works."""


class Partial:
    """Base of classes with some members of rclpy's class; others raise UnsupportedError."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")
        raise UnsupportedMemberError(f"{type(self).__name__}.{name}")


def unsupported(what: str) -> Callable[..., NoReturn]:
    """Create a function that always raises UnsupportedError.

    Args:
        what: The unsupported part.

    Returns:
        The function.
    """

    def refuse(*args: Any, **kwargs: Any) -> NoReturn:
        raise UnsupportedError(what)

    return refuse


def refuse_options(where: str, **options: Any) -> None:
    """Refuse unsupported options.

    Args:
        where: Function that has the options.
        **options: Values of the options.

    Raises:
        UnsupportedError: An option is set.
    """
    for name, value in options.items():
        if value:
            raise UnsupportedError(f"{where}: option '{name}'")


def module_getattr(module: str, folder: Path | None = None) -> Callable[[str], NoReturn]:
    """Create the `__getattr__` of a module whose missing public names are unsupported.

    Args:
        module: Name of the module.
        folder: Folder of a package, whose submodules are no missing names.

    Returns:
        The function.
    """

    def getattr_(name: str) -> NoReturn:
        is_submodule = folder is not None and (folder / f"{name}.py").exists()
        if name.startswith("_") or is_submodule:
            raise AttributeError(f"module '{module}' has no attribute '{name}'")
        raise UnsupportedError(f"{module}.{name}")

    return getattr_
