"""Clients of services."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from threading import Lock
from typing import Any

from quadvel_dds import wire
from quadvel_dds.errors import Partial

from .logging import get_logger
from .task import Future

WAIT_STEP = 0.01  # s, between two looks for a service


class Client(Partial):
    def __init__(
        self, context: Any, client_impl: wire.CallEndpoint, srv_type: Any, srv_name: str, qos_profile: Any,
        callback_group: Any,
    ) -> None:  # fmt: skip
        self.context = context
        self._endpoint = client_impl
        self._reader = client_impl.reader
        self.srv_type = srv_type
        self.service_name = srv_name
        self.qos_profile = qos_profile
        self._numbers = itertools.count(1)
        self._pending: dict[int, Future] = {}
        self._lock = Lock()

    def call_async(self, request: Any) -> Future:
        """Send a request; the future that is returned gets the answer while the node spins."""
        if not isinstance(request, self.srv_type.Request):
            raise TypeError(f"Expected {self.srv_type.Request}, got {type(request)}")
        future = Future()
        with self._lock:
            number = next(self._numbers)
            self._pending[number] = future
        future.add_done_callback(self.remove_pending_request)
        self._endpoint.ask(request, number)
        return future

    def remove_pending_request(self, future: Future) -> None:
        with self._lock:
            self._pending = {number: other for number, other in self._pending.items() if other is not future}

    def service_is_ready(self) -> bool:
        return self._endpoint.is_matched()

    def wait_for_service(self, timeout_sec: float | None = None) -> bool:
        deadline = None if timeout_sec is None or timeout_sec < 0 else time.monotonic() + timeout_sec
        while self.context.ok() and not self.service_is_ready():
            if deadline is not None and time.monotonic() >= deadline:
                return False
            time.sleep(WAIT_STEP)
        return self.service_is_ready()

    def destroy(self) -> None:
        self._endpoint.close()

    def _take(self) -> Callable[[], Any] | None:
        sample = self._reader.take()
        if sample is None:
            return None
        try:
            (client_id, number), response = self._endpoint.decode(sample[0], self.srv_type.Response.TYPENAME)
        except ValueError as error:
            get_logger("rclpy").error(f"dropped an answer of {self.service_name}: {error}")
            return None
        with self._lock:
            future = self._pending.get(number)
        if client_id != self._endpoint.client_id or future is None:
            return None  # the answer to another client, or to a call that was given up
        return lambda: future.set_result(response)
