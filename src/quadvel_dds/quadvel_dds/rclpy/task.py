"""Futures."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Any

from quadvel_dds.errors import Partial, refuse_options


class Future(Partial):
    def __init__(self, *, executor: Any = None) -> None:
        refuse_options("Future", executor=executor)
        self._done = False
        self._result: Any = None
        self._exception: BaseException | None = None
        self._callbacks: list[Callable[[Future], None]] = []
        self._lock = Lock()

    def done(self) -> bool:
        return self._done

    def result(self) -> Any:
        """The result, None as long as there is none. Raises the exception that was set."""
        if self._exception is not None:
            raise self._exception
        return self._result

    def exception(self) -> BaseException | None:
        return self._exception

    def set_result(self, result: Any) -> None:
        self._finish(result, None)

    def set_exception(self, exception: BaseException) -> None:
        self._finish(None, exception)

    def add_done_callback(self, callback: Callable[[Future], None]) -> None:
        """Call `callback(future)` once the future is done."""
        with self._lock:
            if not self._done:
                self._callbacks.append(callback)
                return
        callback(self)

    def _finish(self, result: Any, exception: BaseException | None) -> None:
        with self._lock:
            self._done, self._result, self._exception = True, result, exception
            callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)
