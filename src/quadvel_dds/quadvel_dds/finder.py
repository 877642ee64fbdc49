"""Import hooks for `rclpy` and message packages of the embedded middleware.

`quadvel_dds.install()` registers them; `quadvel_dds.rclpy` and `messages` supply what they import.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec, spec_from_loader
from pathlib import Path
from types import ModuleType

from typing_extensions import override

from quadvel_dds.errors import UnsupportedModuleError

EMBEDDED = str(Path(__file__).parent)


class InterfaceLoader(Loader):
    """Creates the modules `PKG`, `PKG.msg` and `PKG.srv`; classes follow at their first use."""

    @override
    def exec_module(self, module: ModuleType) -> None:
        from quadvel_dds import messages

        package, _, kind = module.__name__.partition(".")
        if not kind:
            return
        names = messages.names_in(package, kind)

        def getattr_(name: str) -> type:
            if name not in names:
                raise AttributeError(f"package '{package}' has no {kind} '{name}'")
            is_service = kind == "srv" and not name.endswith(("_Request", "_Response"))
            make = messages.service_class if is_service else messages.message_class
            cls = make(f"{package}/{kind}/{name}")
            setattr(module, name, cls)
            return cls

        module.__dict__.update(__getattr__=getattr_, __all__=names)


class EmbeddedFinder(MetaPathFinder):
    """Finds `rclpy` next to this file, and message packages in the definitions."""

    @override
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname == "rclpy":
            return PathFinder.find_spec(fullname, [EMBEDDED])
        if fullname.startswith("rclpy."):
            if PathFinder.find_spec(fullname, path) is None:
                raise UnsupportedModuleError(f"module {fullname}")
            return None
        package, _, kind = fullname.partition(".")
        # Only names that look like an interface package make us read the definitions.
        looks_like_one = package.endswith(("_msgs", "_interfaces", "_srvs", "_dds_common"))
        if kind not in ("", "msg", "srv") or not looks_like_one:
            return None
        from quadvel_dds import messages

        if not messages.is_interface_package(package) or (kind and not messages.names_in(package, kind)):
            return None
        return spec_from_loader(fullname, InterfaceLoader(), is_package=not kind)


def is_installed() -> bool:
    """Return whether `rclpy` resolves to the embedded middleware in this process.

    Returns:
        Whether the import hook is installed.
    """
    return any(isinstance(finder, EmbeddedFinder) for finder in sys.meta_path)


def ros2_fault() -> str | None:
    """Return the reason why the installed rclpy is unusable.

    Returns:
        One sentence; None if it is usable or there is none.
    """
    if find_spec("rclpy") is None or is_installed():
        return None
    interfaces = find_spec("quadvel_msgs")
    if interfaces is not None and interfaces.origin is not None:  # else a mere folder of that name
        return None
    return (
        "ROS 2's rclpy is here, but not quadvel_msgs: the nodes run on the embedded middleware; build the workspace "
        "with colcon and source it (ros_ws/README.md), or use the environment of `make ros`"
    )


def install() -> bool:
    """Make `rclpy` and the message packages resolve to the embedded middleware.

    Does nothing if ROS 2's rclpy is importable and usable, unless QUADVEL_MIDDLEWARE=embedded. An
    rclpy without quadvel_msgs is unusable: this is reported on stderr once, and this process and
    its children use the embedded middleware.

    Returns:
        Whether the embedded middleware is used.

    Raises:
        RuntimeError: ROS 2's rclpy is imported already.
    """
    if is_installed():
        return True
    asked = os.environ.get("QUADVEL_MIDDLEWARE") == "embedded"
    fault = None if asked else ros2_fault()
    if not asked and not fault and find_spec("rclpy") is not None:
        return False
    if "rclpy" in sys.modules:
        raise RuntimeError("rclpy of ROS 2 is imported already; call quadvel_dds.install() before")
    if fault:
        print(f"quadvel: {fault}", file=sys.stderr, flush=True)
        os.environ["QUADVEL_MIDDLEWARE"] = "embedded"
    sys.meta_path.insert(0, EmbeddedFinder())
    return True
