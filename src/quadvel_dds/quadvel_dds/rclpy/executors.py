"""The executor: it waits for data and deadlines, and runs callbacks one after the other.

The wait is one DDS wait set with the next timer deadline as its time-out: nothing is polled. Ready timers
come before data, and each ready entity gets one callback before any gets a second, as in rclpy.
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

FOREVER = 2**63 - 1  # ns
LONGEST_WAIT = 200_000_000  # ns: Python runs its handlers of signals only between two waits


class ExternalShutdownException(Exception):
    """The context was shut down while the executor waited."""


class Executor(Partial):
    def __init__(self, *, context: Any = None) -> None:
        refuse_options("Executor", context=context)
        self.context = get_default_context()
        self._nodes: list[Any] = []
        self._tasks: deque[Callable[[], None]] = deque()
        self._ready: deque[Any] = deque()  # entities that had data or were due after the last wait
        self._lock = RLock()
        self._waitset: wire.WaitSet | None = None
        # What the wait set waits for, looked up again once something changed.
        self._timers: list[Timer] = []
        self._waiting: list[Any] = []
        self._has_changed = True
        self._is_shutdown = False
        self.context._wakers.add(self)

    def add_node(self, node: Any) -> bool:
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
        with self._lock:
            if node in self._nodes:
                self._nodes.remove(node)
        self.wake()

    def create_task(self, callback: Callable[..., Any], *args: Any, **kwargs: Any) -> Future:
        """Have the thread that spins call a function; the future that is returned gets its result."""
        if iscoroutinefunction(callback):
            raise UnsupportedError("a coroutine as a callback")
        future = Future()
        self._tasks.append(lambda: future.set_result(callback(*args, **kwargs)))
        self.wake()
        return future

    def wake(self) -> None:
        """End the current wait, because something changed."""
        with self._lock:
            self._has_changed = True
            if self._waitset is not None:
                self._waitset.wake()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop; a spin that runs ends."""
        self.wake()
        with self._lock:
            self._is_shutdown = True
            self._nodes = []
            waitset, self._waitset = self._waitset, None
        if waitset is not None:
            waitset.close()
        return True

    def spin(self) -> None:
        while self.context.ok() and not self._is_shutdown:
            self.spin_once()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run one callback; wait for it for `timeout_sec` (None or negative: for ever)."""
        self._spin_once(_deadline(timeout_sec), lambda: False)

    def spin_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        future.add_done_callback(lambda _: self.wake())
        deadline = _deadline(timeout_sec)
        while self.context.ok() and not future.done() and not self._is_shutdown:
            self._spin_once(deadline, future.done)
            if time.monotonic_ns() >= deadline:
                return

    def _spin_once(self, deadline_ns: int, until: Callable[[], bool]) -> None:
        """Run one callback, if one comes before the deadline, a shutdown, and the moment when `until` holds.

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
        """Wait until something is ready, the deadline, or a wake-up; what is ready goes into `_ready`."""
        with self._lock:
            if self._is_shutdown:
                return
            if self._waitset is None:
                self._waitset = wire.WaitSet(self.context.participant)
            waitset = self._waitset
            if self._has_changed:
                self._has_changed = False
                entities = [entity for node in self._nodes for entity in node._entities()]
                self._timers = [entity for entity in entities if isinstance(entity, Timer)]
                self._waiting = [entity for entity in entities if not isinstance(entity, Timer)]
                waitset.update({entity._reader for entity in self._waiting})
            timers, waiting = self._timers, self._waiting
        if not self.context.ok():  # a signal came while there was no wait set yet that it could have woken
            return
        wakes = (timer._wake_ns() for timer in timers)
        wake_ns = min([deadline_ns, *(wake for wake in wakes if wake is not None)])
        waitset.wait(min(max(0, wake_ns - time.monotonic_ns()), LONGEST_WAIT))
        self._ready.extend(timer for timer in timers if timer.is_ready())
        self._ready.extend(entity for entity in waiting if entity._reader.has_data())


class SingleThreadedExecutor(Executor):
    """Runs callbacks in the thread that spins, as each executor here does."""


def _deadline(timeout_sec: float | None) -> int:
    """Monotonic time in ns at which a wait ends."""
    if timeout_sec is None or timeout_sec < 0:
        return FOREVER
    return time.monotonic_ns() + int(timeout_sec * 1e9)
