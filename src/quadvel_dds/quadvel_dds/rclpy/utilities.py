"""The default context, and the arguments that are not ROS's."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from threading import Lock

from quadvel_dds import arguments

from .context import Context

_default_context: Context | None = None
_lock = Lock()


def get_default_context(*, shutting_down: bool = False) -> Context:
    """The context of this process; a new one after it was shut down."""
    global _default_context
    with _lock:
        if _default_context is None:
            _default_context = Context()
        context = _default_context
        if shutting_down:
            _default_context = None
        return context


def remove_ros_args(args: Sequence[str] | None = None) -> list[str]:
    return arguments.parse(sys.argv if args is None else args).rest


def ok(*, context: Context | None = None) -> bool:
    return (context or get_default_context()).ok()


def shutdown(*, context: Context | None = None) -> None:
    (context or get_default_context(shutting_down=True)).shutdown()


def try_shutdown(*, context: Context | None = None) -> None:
    (context or get_default_context(shutting_down=True)).try_shutdown()


def get_rmw_implementation_identifier() -> str:
    return "quadvel_dds"
