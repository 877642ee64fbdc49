"""What every node does in the same way: its parameters, and its main. For node files only: it needs rclpy."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from socket import socket, socketpair
from threading import Event, Thread
from types import FrameType
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import attrs
import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from .topic_types import PERIOD, ConflictWatch

Config = TypeVar("Config")
STOPS = (signal.SIGINT, signal.SIGTERM)
LONGEST_WAIT = 60.0
"""s, between two looks whether a node goes on; without a limit the executor of events of rclpy 7.1.6 spins"""


class StartError(ValueError):
    """Why a node cannot start, in one sentence."""


def read_parameters(node: Node, config: type[Config]) -> Config:
    """Declare each field of the attrs class `config` as a parameter and return what was set for them.

    A field's default is the parameter's and decides its type, its metadata `description` says what it means
    and in which unit; tuples are lists. Parameters are fixed once the node runs. Raises StartError for a
    parameter that the node does not have, one of another type, and one that the class refuses.
    """
    fields = attrs.fields(config)  # type: ignore[arg-type]
    names = [field.name for field in fields]
    values: dict[str, Any] = {}
    for field in fields:
        default = list(field.default) if isinstance(field.default, tuple) else field.default
        descriptor = ParameterDescriptor(description=field.metadata["description"], read_only=True)
        try:
            value = node.declare_parameter(field.name, default, descriptor).value
        except ParameterException as error:
            raise StartError(f"parameter {field.name}: {error}") from error
        values[field.name] = tuple(value) if isinstance(field.default, tuple) else value
    for name in node._parameter_overrides:  # rclpy keeps silent about parameters that nobody declares
        if not node.has_parameter(name) and not name.startswith("qos_overrides."):
            raise StartError(f"unknown parameter {name}, expected one of {', '.join(names)}")
    try:
        return config(**values)
    except ValueError as error:
        raise StartError(f"parameters: {error.args[0]}") from error


_endings: WeakKeyDictionary[Node, str] = WeakKeyDictionary()


def end(node: Node, error: str = "") -> None:
    """Have `run` end the node: with exit code 0, or with 1 and the sentence `error` if there is one.

    What a callback does instead of sys.exit, which under rclpy may abort the process. Comes back to its caller.
    """
    _endings.setdefault(node, error)
    if (executor := node.executor) is not None:
        executor.create_task(lambda: None)  # ends its wait, if another thread calls


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> None:
    """Start a node and serve it until Ctrl-C, shutdown, or `end`. If it cannot start: one sentence, exit code 2.

    For the main of a process, which ends with it. SIGINT and SIGTERM end it between two callbacks, instead of
    pulling the context away under them as rclpy's own handlers do: they may come at any moment, and again, and cut
    neither start nor end short (Ctrl-C comes twice where a launcher forwards it).
    """
    receiver, sender = socketpair()
    sender.setblocking(False)
    signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    for number in STOPS:
        signal.signal(number, _nothing_more)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)
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
        for number in STOPS:
            signal.signal(number, signal.SIG_IGN)  # while the interpreter ends
    if error := _endings.get(node, ""):
        sys.exit(error)


def _start(make_node: Callable[[], Node], args: list[str] | None) -> Node:
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = make_node()
        node.create_timer(PERIOD, ConflictWatch(node).look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        return node
    except (ValueError, RuntimeError) as error:  # ours, and rclpy's for malformed arguments and files
        print(" ".join(str(error).split()), file=sys.stderr)
        sys.exit(2)


def _serve(node: Node, signals: socket, waker: socket) -> None:
    """Run the node's callbacks until the first byte from `signals`, `end`, or the context's shutdown.

    waker: the other end of `signals`. An executor of events that outlives this crashes the end of the interpreter.
    """
    executor, stopped = _executor(), Event()

    def stop_at_signal() -> None:
        signals.recv(1)
        stopped.set()
        executor.create_task(lambda: None)  # ends its wait

    executor.add_node(node)
    listener = Thread(target=stop_at_signal, daemon=True)
    listener.start()
    try:
        while rclpy.ok() and not stopped.is_set() and node not in _endings:
            executor.spin_once(timeout_sec=LONGEST_WAIT)
    finally:
        with suppress(BlockingIOError):  # so many signals that nothing more fits: the listener has woken
            waker.send(b"\0")
        listener.join()
        executor.remove_node(node)
        executor.shutdown()


def _executor() -> Any:
    """ROS 2's executor of events where it has one (Jazzy from April 2025 on), which the control loop needs there.

    rclpy's usual ones walk through all that a node has, in Python, for each message: docs/decisions/0013.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def _nothing_more(number: int, frame: FrameType | None) -> None:
    """The handler of a signal, which has already written to the wake-up socket."""
