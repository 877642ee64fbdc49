"""The error that says what the embedded middleware does not offer, and what raises it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn


class UnsupportedError(NotImplementedError):
    """A part of rclpy that the embedded middleware does not offer."""

    def __init__(self, what: str) -> None:
        super().__init__(
            f"{what} is not offered by quadvel's embedded middleware (quadvel_dds); use ROS 2 for it"
        )


class UnsupportedModuleError(UnsupportedError, ImportError):
    """A module of rclpy that is not offered; an ImportError, for those who look whether it is there."""


class UnsupportedMemberError(UnsupportedError, AttributeError):
    """A method or property that is not offered; an AttributeError, for those who look whether it is there."""


class Partial:
    """Base of what has a part of the members of rclpy's class: any other public one raises UnsupportedError."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")
        raise UnsupportedMemberError(f"{type(self).__name__}.{name}")


def unsupported(what: str) -> Callable[..., NoReturn]:
    """A function that raises UnsupportedError however it is called."""

    def refuse(*args: Any, **kwargs: Any) -> NoReturn:
        raise UnsupportedError(what)

    return refuse


def refuse_options(where: str, **options: Any) -> None:
    """Raise UnsupportedError if any of the options is set."""
    for name, value in options.items():
        if value:
            raise UnsupportedError(f"{where}: option '{name}'")


def module_getattr(module: str, folder: Path | None = None) -> Callable[[str], NoReturn]:
    """`__getattr__` of a module (of a package, with its `folder`): a public name not there is unsupported."""

    def getattr_(name: str) -> NoReturn:
        is_submodule = folder is not None and (folder / f"{name}.py").exists()
        if name.startswith("_") or is_submodule:
            raise AttributeError(f"module '{module}' has no attribute '{name}'")
        raise UnsupportedError(f"{module}.{name}")

    return getattr_
