"""The part of rclpy that our nodes use, over Cyclone DDS; imported as `rclpy` after `quadvel_dds.install()`.

Names, parameters and defaults are those of rclpy 7.1 (Jazzy). What is not here raises UnsupportedError.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

if __name__ != "rclpy":
    raise ImportError("import this package as 'rclpy', after quadvel_dds.install()")

from quadvel_dds.errors import module_getattr, refuse_options

from . import signals
from .context import Context, get_default_context
from .executors import Executor, SingleThreadedExecutor
from .node import Node
from .parameter import Parameter
from .task import Future

__all__ = [
    "Context",
    "Future",
    "Node",
    "Parameter",
    "create_node",
    "get_default_context",
    "get_global_executor",
    "get_rmw_implementation_identifier",
    "init",
    "ok",
    "shutdown",
    "spin",
    "spin_once",
    "spin_until_future_complete",
    "try_shutdown",
]
__getattr__ = module_getattr(__name__, Path(__file__).parent)


def init(
    *,
    args: list[str] | None = None,
    context: Context | None = None,
    domain_id: int | None = None,
    signal_handler_options: signals.SignalHandlerOptions | None = None,
) -> None:
    """Start communication: read the arguments (sys.argv if None), take over SIGINT and SIGTERM."""
    refuse_options("rclpy.init", context=context)
    get_default_context().init(args, domain_id=domain_id)
    options = signals.SignalHandlerOptions.ALL if signal_handler_options is None else signal_handler_options
    signals.install_signal_handlers(options)


def shutdown(*, context: Context | None = None, uninstall_handlers: bool | None = None) -> None:
    """Stop communication. Raises RuntimeError if it does not run."""
    refuse_options("rclpy.shutdown", context=context)
    get_default_context(shutting_down=True).shutdown()
    if uninstall_handlers is None or uninstall_handlers:
        signals.uninstall_signal_handlers()


def try_shutdown(*, context: Context | None = None) -> None:
    """Stop communication if it runs."""
    refuse_options("rclpy.try_shutdown", context=context)
    get_default_context(shutting_down=True).try_shutdown()


def ok(*, context: Context | None = None) -> bool:
    refuse_options("rclpy.ok", context=context)
    return get_default_context().ok()


def get_rmw_implementation_identifier() -> str:
    return "quadvel_dds"


create_node = Node
_global_executor: Executor | None = None


def get_global_executor() -> Executor:
    """The executor of the spin functions where none is given; it ends with the default context."""
    global _global_executor
    executor = _global_executor
    if executor is None:
        executor = _global_executor = SingleThreadedExecutor()
        # Called at once if a signal has shut the context down already: the executor then ends at its first step.
        get_default_context().on_shutdown(_forget_global_executor)
    return executor


def _forget_global_executor() -> None:
    global _global_executor
    executor, _global_executor = _global_executor, None
    if executor is not None:
        executor.wake()


def spin(node: Node, executor: Any = None) -> None:
    """Run the callbacks of a node until the context is shut down."""
    executor = executor or get_global_executor()
    try:
        executor.add_node(node)
        while executor.context.ok():
            executor.spin_once()
    finally:
        executor.remove_node(node)


def spin_once(node: Node, *, executor: Any = None, timeout_sec: float | None = None) -> None:
    """Run one callback; wait for it for `timeout_sec` (None or negative: for ever)."""
    executor = executor or get_global_executor()
    try:
        executor.add_node(node)
        executor.spin_once(timeout_sec=timeout_sec)
    finally:
        executor.remove_node(node)


def spin_until_future_complete(
    node: Node, future: Future, executor: Any = None, timeout_sec: float | None = None
) -> None:
    """Run callbacks until a future is done, the time is up, or the context is shut down."""
    executor = executor or get_global_executor()
    added = False
    try:
        added = executor.add_node(node)
        executor.spin_until_future_complete(future, timeout_sec)
    finally:
        if added:
            executor.remove_node(node)
