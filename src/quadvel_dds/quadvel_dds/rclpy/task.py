"""Futures, and tasks that an executor runs."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from threading import Lock
from typing import Any

from quadvel_dds.errors import UnsupportedError


class Future:
    def __init__(self, *, executor: Any = None) -> None:
        self._executor = executor
        self._done = self._cancelled = False
        self._result: Any = None
        self._exception: BaseException | None = None
        self._callbacks: list[Callable[[Future], None]] = []
        self._lock = Lock()

    def done(self) -> bool:
        return self._done or self._cancelled

    def cancelled(self) -> bool:
        return self._cancelled

    def cancel(self) -> None:
        if not self.done():
            self._finish(cancelled=True)

    def result(self) -> Any:
        """The result, None as long as there is none. Raises the exception that was set."""
        if self._exception is not None:
            raise self._exception
        return self._result

    def exception(self) -> BaseException | None:
        return self._exception

    def set_result(self, result: Any) -> None:
        self._finish(result=result)

    def set_exception(self, exception: BaseException) -> None:
        self._finish(exception=exception)

    def add_done_callback(self, callback: Callable[[Future], None]) -> None:
        """Call `callback(future)` once the future is done; in the executor, if the future has one."""
        with self._lock:
            if not self.done():
                self._callbacks.append(callback)
                return
        self._schedule(callback)

    def _finish(
        self, result: Any = None, exception: BaseException | None = None, cancelled: bool = False
    ) -> None:
        with self._lock:
            self._result, self._exception = result, exception
            self._done, self._cancelled = not cancelled, cancelled
            callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            self._schedule(callback)

    def _schedule(self, callback: Callable[[Future], None]) -> None:
        if self._executor is not None:
            self._executor.create_task(callback, self)
        else:
            callback(self)


class Task(Future):
    """A callback that runs in an executor; its return value is the result."""

    def __init__(
        self, handler: Callable[..., Any], args: Any = None, kwargs: Any = None, executor: Any = None
    ) -> None:
        if inspect.iscoroutine(handler) or inspect.iscoroutinefunction(handler):
            raise UnsupportedError("a coroutine as a callback")
        super().__init__(executor=executor)
        self._handler, self._args, self._kwargs = handler, args or (), kwargs or {}

    def __call__(self) -> None:
        try:
            self.set_result(self._handler(*self._args, **self._kwargs))
        except Exception as error:
            self.set_exception(error)
