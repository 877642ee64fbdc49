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
        self._callbacks: list[Callable[[Future], None]] = []
        self._lock = Lock()

    def done(self) -> bool:
        return self._done

    def result(self) -> Any:
        """The result, None as long as there is none."""
        return self._result

    def set_result(self, result: Any) -> None:
        with self._lock:
            self._done, self._result = True, result
            callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)

    def add_done_callback(self, callback: Callable[[Future], None]) -> None:
        """Call `callback(future)` once the future is done."""
        with self._lock:
            if not self._done:
                self._callbacks.append(callback)
                return
        callback(self)
