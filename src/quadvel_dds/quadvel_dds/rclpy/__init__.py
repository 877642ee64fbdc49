"""Subset of rclpy over Cyclone DDS; imported as `rclpy` after `quadvel_dds.install()`.

Names, parameters and defaults are those of rclpy 7.1 (Jazzy). Missing parts raise UnsupportedError.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

if __name__ != "rclpy":
    raise ImportError("import this package as 'rclpy', after quadvel_dds.install()")

from quadvel_dds.errors import module_getattr, refuse_options

from .context import Context as Context
from .context import get_default_context
from .executors import Executor, SingleThreadedExecutor
from .node import Node as Node
from .parameter import Parameter as Parameter
from .signals import SignalHandlerOptions
from .task import Future as Future

__getattr__ = module_getattr(__name__, Path(__file__).parent)


def init(
    *, args: list[str] | None = None, context: Context | None = None, domain_id: int | None = None,
    signal_handler_options: SignalHandlerOptions | None = None,
) -> None:  # fmt: skip
    """Start communication. Signal handlers are not changed, see `signals`.

    Args:
        args: Command line; None: `sys.argv`.
        context: Not supported.
        domain_id: Number of the domain; None: ROS_DOMAIN_ID.
        signal_handler_options: Ignored.
    """
    refuse_options("rclpy.init", context=context)
    get_default_context().init(args, domain_id=domain_id)


def shutdown(*, context: Context | None = None, uninstall_handlers: bool | None = None) -> None:
    """Stop communication. RuntimeError propagates if it does not run.

    Args:
        context: Not supported.
        uninstall_handlers: Not supported.
    """
    refuse_options("rclpy.shutdown", context=context, uninstall_handlers=uninstall_handlers)
    get_default_context(shutting_down=True).shutdown()


def try_shutdown(*, context: Context | None = None) -> None:
    """Stop communication if it runs.

    Args:
        context: Not supported.
    """
    refuse_options("rclpy.try_shutdown", context=context)
    get_default_context(shutting_down=True).try_shutdown()


def ok(*, context: Context | None = None) -> bool:
    """Return whether communication runs.

    Args:
        context: Not supported.

    Returns:
        True between `init` and `shutdown`.
    """
    refuse_options("rclpy.ok", context=context)
    return get_default_context().ok()


create_node = Node
_global_executor: Executor | None = None


@contextmanager
def _added(node: Node, executor: Any) -> Iterator[Executor]:
    """Add the node to the given executor, or to the shared one of the context, for a while."""
    global _global_executor
    if _global_executor is None or _global_executor.context is not get_default_context():
        _global_executor = SingleThreadedExecutor()
    executor = executor or _global_executor
    is_new = executor.add_node(node)
    try:
        yield executor
    finally:
        if is_new:
            executor.remove_node(node)


def spin(node: Node, executor: Any = None) -> None:
    """Run the callbacks of a node until the context is shut down.

    Args:
        node: The node.
        executor: Executor; None: the shared one.
    """
    with _added(node, executor) as serving:
        serving.spin()


def spin_once(node: Node, *, executor: Any = None, timeout_sec: float | None = None) -> None:
    """Run one callback.

    Args:
        node: The node.
        executor: Executor; None: the shared one.
        timeout_sec: Longest wait for a callback, s; None or negative: unlimited.
    """
    with _added(node, executor) as serving:
        serving.spin_once(timeout_sec)


def spin_until_future_complete(
    node: Node, future: Future, executor: Any = None, timeout_sec: float | None = None
) -> None:
    """Run callbacks until a future is done, the timeout, or a shutdown of the context.

    Args:
        node: The node.
        future: The future.
        executor: Executor; None: the shared one.
        timeout_sec: Timeout, s; None or negative: unlimited.
    """
    with _added(node, executor) as serving:
        serving.spin_until_future_complete(future, timeout_sec)
