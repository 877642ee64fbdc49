"""Executors: they wait for data and deadlines, and run callbacks.

The wait is one DDS wait set with the next timer deadline as its time-out: nothing is polled. Ready timers
come before data, and each ready entity gets one callback before any gets a second, as in rclpy.
"""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future as ThreadFuture
from concurrent.futures import ThreadPoolExecutor
from threading import RLock
from typing import Any

from quadvel_dds import wire
from quadvel_dds.errors import unsupported

from .task import Future, Task
from .timer import Timer
from .utilities import get_default_context

FOREVER = 2**63 - 1
Work = Callable[[], Any]


class ExternalShutdownException(Exception):
    """The context was shut down while the executor waited."""


class Executor(ABC):
    def __init__(self, *, context: Any = None) -> None:
        self._context = context or get_default_context()
        self._nodes: list[Any] = []
        self._tasks: deque[Task] = deque()
        self._ready: deque[Any] = deque()  # entities that had data or were due after the last wait
        self._lock = RLock()
        self._waitset: wire.WaitSet | None = None
        # What the wait set waits for, looked up again once something changed.
        self._timers: list[Timer] = []
        self._waiting: dict[int, Any] = {}
        self._has_changed = True
        self._is_shutdown = False
        self._context._wakers.add(self)

    @property
    def context(self) -> Any:
        return self._context

    def add_node(self, node: Any) -> bool:
        with self._lock:
            if node in self._nodes:
                return False
            self._nodes.append(node)
        node.executor = self
        self.wake()
        return True

    def remove_node(self, node: Any) -> None:
        with self._lock:
            if node in self._nodes:
                self._nodes.remove(node)
        self.wake()

    def get_nodes(self) -> list[Any]:
        with self._lock:
            return list(self._nodes)

    def create_task(self, callback: Callable[..., Any], *args: Any, **kwargs: Any) -> Task:
        task = Task(callback, args, kwargs, executor=self)
        self._tasks.append(task)
        self.wake()
        return task

    def wake(self) -> None:
        """End the current wait, because something changed."""
        with self._lock:
            self._has_changed = True
            if self._waitset is not None:
                self._waitset.wake()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop; True once no callback runs any more."""
        self.wake()
        with self._lock:
            self._is_shutdown = True
            self._nodes = []
            waitset, self._waitset = self._waitset, None
        if waitset is not None:
            waitset.close()
        return True

    def can_execute(self, entity: Any) -> bool:
        return bool(entity.callback_group.can_execute(entity))

    def spin(self) -> None:
        while self._context.ok() and not self._is_shutdown:
            self.spin_once()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run one callback; wait for it for `timeout_sec` (None or negative: for ever)."""
        self._spin_once(_deadline(timeout_sec), lambda: False)

    def spin_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        future.add_done_callback(lambda _: self.wake())
        deadline = _deadline(timeout_sec)
        while self._context.ok() and not future.done() and not self._is_shutdown:
            self._spin_once(deadline, future.done)
            if time.monotonic_ns() >= deadline:
                return

    def spin_once_until_future_complete(self, future: Future, timeout_sec: Any = None) -> None:
        future.add_done_callback(lambda _: self.wake())
        self._spin_once(_deadline(timeout_sec), future.done)

    @abstractmethod
    def _spin_once(self, deadline_ns: int, until: Callable[[], bool]) -> None:
        """Run one callback, which `_next_work` waits for, or have it run."""

    def _next_work(self, deadline_ns: int, until: Callable[[], bool]) -> Work | None:
        """The next callback, its group entered; None at the deadline, after shutdown, or once `until` holds.

        Raises ExternalShutdownException if the context is shut down.
        """
        first = True
        while not self._is_shutdown and not until():
            if not self._context.ok():
                raise ExternalShutdownException
            if self._tasks:
                return _run_task(self._tasks.popleft())
            while self._ready:
                work = self._claim(self._ready.popleft())
                if work is not None:
                    return work
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
                self._waitset = wire.WaitSet(self._context.participant)
            waitset = self._waitset
            if self._has_changed:
                self._look_up(waitset)
            timers, waiting = self._timers, self._waiting
        if not self._context.ok():  # a signal came while there was no wait set yet that it could have woken
            return
        wakes = [timer._wake_ns() for timer in timers if not timer.is_canceled()]
        wake_ns = min([deadline_ns, *(wake for wake in wakes if wake is not None)])
        keys = waitset.wait(max(0, wake_ns - time.monotonic_ns()) if wake_ns < FOREVER else FOREVER)
        self._ready.extend(timer for timer in timers if timer.is_ready())
        if keys:
            self._ready.extend(entity for key, entity in waiting.items() if key in keys)

    def _look_up(self, waitset: wire.WaitSet) -> None:
        """What may be executed now; where a group is busy, this is to be asked again."""
        entities = [entity for node in self._nodes for entity in node._entities()]
        free = [entity for entity in entities if self.can_execute(entity)]
        self._has_changed = len(free) < len(entities)
        self._timers = [entity for entity in free if isinstance(entity, Timer)]
        self._waiting = {id(entity._reader): entity for entity in free if not isinstance(entity, Timer)}
        waitset.update({key: entity._reader for key, entity in self._waiting.items()})

    def _claim(self, entity: Any) -> Work | None:
        """Take what is ready of an entity, if its callback group is free."""
        group = entity.callback_group
        if not group.beginning_execution(entity):
            self._has_changed = True
            return None
        callback = entity._take()
        if callback is None:
            group.ending_execution(entity)
            return None

        def work() -> None:
            try:
                callback()
            finally:
                group.ending_execution(entity)

        return work

    def __enter__(self) -> Executor:
        return self

    def __exit__(self, *exception: Any) -> None:
        self.shutdown()

    wait_for_ready_callbacks = unsupported("Executor.wait_for_ready_callbacks")


class SingleThreadedExecutor(Executor):
    """Runs callbacks in the thread that spins."""

    def __init__(self, *, context: Any = None) -> None:
        super().__init__(context=context)

    def _spin_once(self, deadline_ns: int, until: Callable[[], bool]) -> None:
        work = self._next_work(deadline_ns, until)
        if work is not None:
            work()


class MultiThreadedExecutor(Executor):
    """Runs callbacks in a pool of threads; an exception in one is raised by the thread that spins."""

    def __init__(self, num_threads: int | None = None, *, context: Any = None) -> None:
        super().__init__(context=context)
        self._pool = ThreadPoolExecutor(num_threads or len(os.sched_getaffinity(0)))
        self._running: list[ThreadFuture[Any]] = []

    def _spin_once(self, deadline_ns: int, until: Callable[[], bool]) -> None:
        try:
            work = self._next_work(
                deadline_ns, lambda: until() or any(future.done() for future in self._running)
            )
        except ExternalShutdownException:
            return
        if work is not None:
            future = self._pool.submit(work)
            self._running.append(future)
            # The group may be free again, or there may be an exception to raise.
            future.add_done_callback(lambda _: self.wake())
        done = [future for future in self._running if future.done()]
        self._running = [future for future in self._running if not future.done()]
        for future in done:
            future.result()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        super().shutdown(timeout_sec)
        self._pool.shutdown(wait=timeout_sec is None or timeout_sec < 0)
        return all(future.done() for future in self._running)


def _run_task(task: Task) -> Work:
    def work() -> None:
        task()
        task.result()

    return work


def _deadline(timeout_sec: float | None) -> int:
    """Monotonic time in ns at which a wait ends."""
    if timeout_sec is None or timeout_sec < 0:
        return FOREVER
    return time.monotonic_ns() + int(timeout_sec * 1e9)
