"""Executor: waits for data and timers, and runs callbacks one after the other.

The wait is one DDS wait set whose timeout is the next timer deadline; nothing is polled. As in
rclpy, ready timers come before data, and each ready entity gets one callback before any gets a
second.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from inspect import iscoroutinefunction
from threading import RLock
from typing import Any

from quadvel_dds import wire
from quadvel_dds.errors import Partial, UnsupportedError, module_getattr, refuse_options

from .context import get_default_context
from .task import Future
from .timer import Timer

__getattr__ = module_getattr(__name__)

NEVER_NS = 2**63 - 1
MAX_WAIT_NS = 200_000_000
"""Longest single wait: Python runs signal handlers only between two waits."""


class ExternalShutdownException(Exception):
    """The context was shut down while the executor waited."""


class Executor(Partial):
    """Executor with one thread, see rclpy's Executor.

    Attributes:
        context: Context of the process.
    """

    def __init__(self, *, context: Any = None) -> None:
        """Create an executor without nodes.

        Args:
            context: Not supported.
        """
        refuse_options("Executor", context=context)
        self.context = get_default_context()
        self._nodes: list[Any] = []
        self._tasks: deque[Callable[[], None]] = deque()
        self._ready: deque[Any] = deque()  # entities that had data or were due after the last wait
        self._lock = RLock()
        self._waitset: wire.WaitSet | None = None
        # What is waited for, looked up again once something changed: timers that run, and the other
        # entities with their ranks by their readers.
        self._timers: list[Timer] = []
        self._ranked: dict[wire.Reader, tuple[int, Any]] = {}
        self._has_changed = True
        self._is_shutdown = False
        self.context._wakers.add(self)

    def add_node(self, node: Any) -> bool:
        """Add a node; it leaves its former executor.

        Args:
            node: The node.

        Returns:
            Whether the node was new here.
        """
        with self._lock:
            if node in self._nodes:
                return False
            self._nodes.append(node)
        former, node.executor = node.executor, self
        if former not in (None, self):
            former.remove_node(node)
        self.wake()
        return True

    def remove_node(self, node: Any) -> None:
        """Remove a node.

        Args:
            node: The node.
        """
        with self._lock:
            if node in self._nodes:
                self._nodes.remove(node)
        self.wake()

    def create_task(self, callback: Callable[..., Any], *args: Any, **kwargs: Any) -> Future:
        """Run a function in the spinning thread.

        Args:
            callback: The function.
            *args: Its arguments.
            **kwargs: Its keyword arguments.

        Returns:
            Future of its result.

        Raises:
            UnsupportedError: It is a coroutine function.
        """
        if iscoroutinefunction(callback):
            raise UnsupportedError("a coroutine as a callback")
        future = Future()
        self._tasks.append(lambda: future.set_result(callback(*args, **kwargs)))
        self.wake()
        return future

    def wake(self) -> None:
        """End the present wait after a change; may be called from any thread."""
        with self._lock:
            self._has_changed = True
            if self._waitset is not None:
                self._waitset.wake()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop the executor; a running `spin` returns.

        Args:
            timeout_sec: Ignored.

        Returns:
            True.
        """
        self.wake()
        with self._lock:
            self._is_shutdown = True
            self._nodes = []
            waitset, self._waitset = self._waitset, None
        if waitset is not None:
            waitset.close()
        return True

    def spin(self) -> None:
        """Run callbacks until a shutdown."""
        while self.context.ok() and not self._is_shutdown:
            self.spin_once()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run one callback.

        Args:
            timeout_sec: Longest wait for a callback, s; None or negative: unlimited.
        """
        self._spin_once(_deadline(timeout_sec), _never)

    def spin_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        """Run callbacks until a future is done, the timeout, or a shutdown.

        Args:
            future: The future.
            timeout_sec: Timeout, s; None or negative: unlimited.
        """
        future.add_done_callback(lambda _: self.wake())
        deadline = _deadline(timeout_sec)
        while self.context.ok() and not future.done() and not self._is_shutdown:
            self._spin_once(deadline, future.done)
            if time.monotonic_ns() >= deadline:
                return

    def _spin_once(self, deadline_ns: int, until: Callable[[], bool]) -> None:
        """Run one callback unless the deadline, a shutdown or the condition `until` comes first.

        Raises ExternalShutdownException if the context is shut down.
        """
        first = True
        while not self._is_shutdown and not until():
            if not self.context.ok():
                raise ExternalShutdownException
            if self._tasks:
                return self._tasks.popleft()()
            while self._ready:
                if (callback := self._ready.popleft()._take()) is not None:
                    callback()
                    return None
            if not first and time.monotonic_ns() >= deadline_ns:
                return None
            first = False
            self._wait(deadline_ns)
        return None

    def _wait(self, deadline_ns: int) -> None:
        """Wait for a ready entity, the deadline or `wake`; ready entities go into `_ready`."""
        if self._has_changed:
            self._look_up_entities()
        waitset = self._waitset
        if waitset is None or not self.context.ok():  # a signal may have come before it existed
            return
        wakes = [(wake, timer) for timer in self._timers if (wake := timer._wake_ns()) is not None]
        wake_ns = min([deadline_ns, *(wake for wake, _ in wakes)])
        found = waitset.wait(min(max(0, wake_ns - time.monotonic_ns()), MAX_WAIT_NS))
        now = time.monotonic_ns()
        self._ready.extend(timer for wake, timer in wakes if wake <= now)
        if found:
            ranked = sorted(self._ranked[reader] for reader in found if reader in self._ranked)
            self._ready.extend(entity for _, entity in ranked)

    def _look_up_entities(self) -> None:
        """Attach the present entities of all nodes to the wait set; do nothing after a shutdown."""
        with self._lock:
            if self._is_shutdown:
                return
            self._has_changed = False
            if self._waitset is None:
                self._waitset = wire.WaitSet(self.context.participant)
            entities = [entity for node in self._nodes for entity in node._entities()]
            self._timers = [one for one in entities if isinstance(one, Timer) and not one._canceled]
            waiting = [entity for entity in entities if not isinstance(entity, Timer)]
            self._ranked = {entity._reader: (rank, entity) for rank, entity in enumerate(waiting)}
            self._waitset.update(set(self._ranked))


class SingleThreadedExecutor(Executor):
    """Executor that runs callbacks in the spinning thread, as every executor here does."""


def _never() -> bool:
    """Return False: the condition of a spin that has none."""
    return False


def _deadline(timeout_sec: float | None) -> int:
    """Return the monotonic time in ns at which a wait ends."""
    if timeout_sec is None or timeout_sec < 0:
        return NEVER_NS
    return time.monotonic_ns() + int(timeout_sec * 1e9)
