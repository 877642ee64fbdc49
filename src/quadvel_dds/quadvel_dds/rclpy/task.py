"""Futures.

`client` returns futures, and the executor completes them while the node spins.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Any

from quadvel_dds.errors import Partial, refuse_options


class Future(Partial):
    """Future, see rclpy's Future."""

    def __init__(self, *, executor: Any = None) -> None:
        """Create a future without result.

        Args:
            executor: Not supported.
        """
        refuse_options("Future", executor=executor)
        self._done = False
        self._result: Any = None
        self._callbacks: list[Callable[[Future], None]] = []
        self._lock = Lock()

    def done(self) -> bool:
        """Return whether the future has a result.

        Returns:
            Whether it is done.
        """
        return self._done

    def result(self) -> Any:
        """Return the result.

        Returns:
            The result; None if there is none yet.
        """
        return self._result

    def set_result(self, result: Any) -> None:
        """Set the result and run the callbacks.

        Args:
            result: The result.
        """
        with self._lock:
            self._done, self._result = True, result
            callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)

    def add_done_callback(self, callback: Callable[[Future], None]) -> None:
        """Register a callback.

        Args:
            callback: Called with the future once it is done, immediately if it is done already.
        """
        with self._lock:
            if not self._done:
                self._callbacks.append(callback)
                return
        callback(self)
