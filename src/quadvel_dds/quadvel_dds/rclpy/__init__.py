"""The part of rclpy that our nodes use, over Cyclone DDS; imported as `rclpy` after `quadvel_dds.install()`.

Names, parameters and defaults are those of rclpy 7.1 (Jazzy). What is not here raises UnsupportedError.
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
    """Start communication: read the arguments (sys.argv if None). No signals are taken over: see `signals`."""
    refuse_options("rclpy.init", context=context)
    get_default_context().init(args, domain_id=domain_id)


def shutdown(*, context: Context | None = None, uninstall_handlers: bool | None = None) -> None:
    """Stop communication. Raises RuntimeError if it does not run."""
    refuse_options("rclpy.shutdown", context=context, uninstall_handlers=uninstall_handlers)
    get_default_context(shutting_down=True).shutdown()


def try_shutdown(*, context: Context | None = None) -> None:
    """Stop communication if it runs."""
    refuse_options("rclpy.try_shutdown", context=context)
    get_default_context(shutting_down=True).try_shutdown()


def ok(*, context: Context | None = None) -> bool:
    refuse_options("rclpy.ok", context=context)
    return get_default_context().ok()


create_node = Node
_global_executor: Executor | None = None


@contextmanager
def _added(node: Node, executor: Any) -> Iterator[Executor]:
    """The executor given, or one that all calls share as long as the context lives, with the node in it."""
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
    """Run the callbacks of a node until the context is shut down."""
    with _added(node, executor) as serving:
        serving.spin()


def spin_once(node: Node, *, executor: Any = None, timeout_sec: float | None = None) -> None:
    """Run one callback; wait for it for `timeout_sec` (None or negative: for ever)."""
    with _added(node, executor) as serving:
        serving.spin_once(timeout_sec)


def spin_until_future_complete(
    node: Node, future: Future, executor: Any = None, timeout_sec: float | None = None
) -> None:
    """Run callbacks until a future is done, the time is up, or the context is shut down."""
    with _added(node, executor) as serving:
        serving.spin_until_future_complete(future, timeout_sec)
