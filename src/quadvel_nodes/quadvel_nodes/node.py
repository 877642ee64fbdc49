"""Parameters, start and shutdown of a node. For node files only: this module needs rclpy.

Nodes report with `diagnostics` and convert messages with `messages`.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from socket import socket, socketpair
from threading import Event, Thread
from types import FrameType
from typing import Any, TypeVar

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from .parameters import make_record, parameter_fields
from .publishers import has_publisher
from .topic_types import CHECK_PERIOD_S, ConflictWatch

Config = TypeVar("Config")
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
MAX_SPIN_WAIT_S = 60.0
"""s, longest wait of the executor for an event; without a limit the EventsExecutor of rclpy 7.1.6
spins.
"""


class StartError(ValueError):
    """A node cannot start; the text is the reason, in one sentence."""


def read_parameters(node: Node, config: type[Config]) -> Config:
    """Declare the parameters of an attrs class at a node and return the values that were set.

    The default of a field is the default of its parameter and decides the type. The metadata
    `description` of a field describes the parameter and its unit. A field whose default is a record
    stands for the fields of that one. Tuples become lists. Parameters are read-only while the node
    runs.

    Args:
        node: The node that declares the parameters.
        config: An attrs class, as for `parameter_fields`.

    Returns:
        An instance of `config`.

    Raises:
        StartError: A parameter is unknown, has the wrong type, or is rejected by the class.
    """
    fields = parameter_fields(config)
    values: dict[str, Any] = {}
    for field in fields.values():
        default = list(field.default) if isinstance(field.default, tuple) else field.default
        descriptor = ParameterDescriptor(description=field.metadata["description"], read_only=True)
        try:
            value = node.declare_parameter(field.name, default, descriptor).value
        except ParameterException as error:
            raise StartError(f"parameter {field.name}: {error}") from error
        values[field.name] = tuple(value) if isinstance(field.default, tuple) else value
    for name in node._parameter_overrides:  # rclpy ignores undeclared parameters silently
        if not node.has_parameter(name) and not name.startswith("qos_overrides."):
            raise StartError(f"unknown parameter {name}, expected one of {', '.join(fields)}")
    try:
        return make_record(config, values)
    except ValueError as error:
        raise StartError(f"parameters: {error.args[0]}") from error


def create_only_publisher(node: Node, kind: Any, topic: str, depth: int, remedy: str = "") -> Any:
    """Create the publisher of a topic that must have one alone.

    Args:
        node: The node.
        kind: Type of the messages.
        topic: Name of the topic, as for `Node.create_publisher`.
        depth: Depth of its queue.
        remedy: What else the operator may want, after a semicolon.

    Returns:
        The publisher.

    Raises:
        StartError: There is a publisher already.
    """
    if has_publisher(node, node.resolve_topic_name(topic)):
        raise StartError(
            f"{node.get_name()}: {topic} is already published, by another {node.get_name()} or one that was killed "
            f"less than 10 s ago{remedy and '; '}{remedy}"
        )
    return node.create_publisher(kind, topic, depth)


_exit_requests: dict[Node, str] = {}


def request_exit(node: Node, error: str = "") -> None:
    """Make `run` stop the node, with exit code 0, or 1 if there is an error.

    Callbacks use this instead of sys.exit, which can abort the process under rclpy. The function
    returns to its caller; the first request counts.

    Args:
        node: The node to stop.
        error: One sentence that `run` prints, or "" for a regular exit.
    """
    _exit_requests.setdefault(node, error)
    if (executor := node.executor) is not None:
        executor.create_task(lambda: None)  # wakes the executor if another thread calls this


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> None:
    """Start a node and run its callbacks until Ctrl-C, shutdown, or `request_exit`.

    This is the main function of a node's process. SIGINT and SIGTERM stop the node between two
    callbacks; the handlers of rclpy would invalidate the context during a callback. A signal can
    arrive at any time and more than once (a launcher may forward Ctrl-C), and interrupts neither
    the start nor the shutdown.

    Args:
        make_node: Creates the node, usually its class.
        args: Command line arguments; None for those of the process.

    Raises:
        SystemExit: Code 2 if the node cannot start; code 1 if `request_exit` gave an error.
    """
    receiver, sender = socketpair()
    sender.setblocking(False)
    signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    for number in STOP_SIGNALS:
        signal.signal(number, _ignore_signal)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
    node = None
    try:
        node = _start(make_node, args)
        _serve(node, receiver, sender)
    except ExternalShutdownException:
        pass
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        for number in STOP_SIGNALS:
            signal.signal(number, signal.SIG_IGN)  # while the interpreter ends
    if error := _exit_requests.pop(node, ""):
        sys.exit(error)


def _start(make_node: Callable[[], Node], args: list[str] | None) -> Node:
    """Initialise rclpy and create the node; exit with code 2 if that fails."""
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = make_node()
        node.create_timer(
            CHECK_PERIOD_S, ConflictWatch(node).check, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        return node
    except (
        ValueError,
        OSError,
        RuntimeError,
    ) as error:  # from quadvel, or from rclpy for malformed arguments and files
        print(" ".join(str(error).split()), file=sys.stderr)
        sys.exit(2)


def _serve(node: Node, signals: socket, waker: socket) -> None:
    """Run callbacks until a byte from `signals`, a call of `request_exit`, or the context's shutdown.

    An EventsExecutor that is still alive when the interpreter exits crashes it, so this function
    shuts its executor down.

    Args:
        node: The node to run.
        signals: Socket to which signal handlers write.
        waker: The other end of `signals`.
    """
    executor, stopped = _executor(), Event()

    def stop_at_signal() -> None:
        signals.recv(1)
        stopped.set()
        executor.create_task(lambda: None)  # wakes the executor

    executor.add_node(node)
    listener = Thread(target=stop_at_signal, daemon=True)
    listener.start()
    try:
        while node.context.ok() and not stopped.is_set() and node not in _exit_requests:
            executor.spin_once(timeout_sec=MAX_SPIN_WAIT_S)
    finally:
        with suppress(BlockingIOError):  # the buffer is full of signals: the listener is already awake
            waker.send(b"\0")
        listener.join()
        executor.remove_node(node)
        executor.shutdown()


def _executor() -> Any:
    """Return an EventsExecutor where ROS 2 has one (Jazzy from April 2025 on), else the standard one.

    The standard executors iterate over all entities of a node, in Python, for each message
    (docs/decisions/0013), which is too slow for the control loop.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def _ignore_signal(number: int, frame: FrameType | None) -> None:
    """Handle a signal by doing nothing: the wake-up socket has already received it."""
