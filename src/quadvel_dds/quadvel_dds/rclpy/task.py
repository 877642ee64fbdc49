"""Futures, and tasks that an executor runs."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from threading import Lock
from typing import Any

from quadvel_dds.errors import Partial, UnsupportedError, refuse_options


class Future(Partial):
    def __init__(self, *, executor: Any = None) -> None:
        refuse_options("Future", executor=executor)
        self._done = self._cancelled = False
        self._result: Any = None
        self._exception: BaseException | None = None
        self._callbacks: list[Callable[[Future], None]] = []
        self._lock = Lock()

    def done(self) -> bool:
        return self._done

    def cancelled(self) -> bool:
        return self._cancelled

    def cancel(self) -> None:
        if not self._done:
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
        """Call `callback(future)` once the future is done."""
        with self._lock:
            if not self._done:
                self._callbacks.append(callback)
                return
        callback(self)

    def _finish(
        self, result: Any = None, exception: BaseException | None = None, cancelled: bool = False
    ) -> None:
        with self._lock:
            self._result, self._exception = result, exception
            self._done, self._cancelled = True, cancelled
            callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)


class Task(Future):
    """A callback that runs in an executor; its return value is the result."""

    def __init__(self, handler: Callable[..., Any], args: Any = (), kwargs: Any = None) -> None:
        if inspect.iscoroutine(handler) or inspect.iscoroutinefunction(handler):
            raise UnsupportedError("a coroutine as a callback")
        super().__init__()
        self._call = lambda: handler(*args, **(kwargs or {}))

    def __call__(self) -> None:
        try:
            self.set_result(self._call())
        except Exception as error:
            self.set_exception(error)
            raise
