"""Orders of the pages between the server's thread and the thread that executes them.

A page can send thousands of orders at once. The queue stays short: it keeps the newest order of
each kind, and STOP passes all others. `view_node` and `replay` empty it.
"""

from __future__ import annotations

from threading import Lock

from .page_protocol import Hold, LetGo, PageMessage, Record, Stop

MAX_WAITING_ORDERS = 64
"""Largest number of waiting orders: one of each kind, and one hold for each page."""


class OrderQueue:
    """Waiting orders in the order of their arrival; all methods may be called from any thread."""

    def __init__(self) -> None:
        self._waiting: dict[object, tuple[int, PageMessage]] = {}
        self._lock = Lock()

    def put(self, page: int, order: PageMessage) -> bool:
        """Add an order. It replaces a waiting one of the same kind.

        STOP comes first, and removes all waiting orders but Record. A full queue refuses other
        orders; only holds of very many pages can fill it, and pages repeat their holds.

        Args:
            page: Number of the page.
            order: The order.

        Returns:
            True for a STOP while no other waits: it has to be executed at once.
        """
        with self._lock:
            if isinstance(order, Stop):
                is_first = Stop not in self._waiting
                recording = self._waiting.get(Record)
                self._waiting = {Stop: (page, order)}
                if recording is not None:
                    self._waiting[Record] = recording
                return is_first
            kind = page if isinstance(order, Hold | LetGo) else type(order)
            self._waiting.pop(kind, None)  # the new one comes last
            if len(self._waiting) < MAX_WAITING_ORDERS:
                self._waiting[kind] = page, order
            return False

    def take_all(self) -> list[tuple[int, PageMessage]]:
        """Remove all waiting orders.

        Returns:
            Number of the page, and the order.
        """
        with self._lock:
            taken, self._waiting = self._waiting, {}
        return list(taken.values())
