"""Clients of services."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from threading import Event, Lock
from typing import Any

from quadvel_dds import wire
from quadvel_dds.errors import unsupported

from .logging import get_logger
from .task import Future

WAIT_STEP = 0.01  # s, between two looks for a service


class Client:
    def __init__(
        self,
        context: Any,
        client_impl: wire.CallEndpoint,
        srv_type: Any,
        srv_name: str,
        qos_profile: Any,
        callback_group: Any,
    ) -> None:
        self.context = context
        self._endpoint = client_impl
        self._reader = client_impl.reader
        self.srv_type = srv_type
        self.srv_name = srv_name
        self.qos_profile = qos_profile
        self.callback_group = callback_group
        self._numbers = itertools.count(1)
        self._pending: dict[int, Future] = {}
        self._lock = Lock()

    def call(self, request: Any, timeout_sec: float | None = None) -> Any:
        """Call and wait for the answer, which another thread takes by spinning; None after the time-out."""
        answered = Event()
        future = self.call_async(request)
        future.add_done_callback(lambda _: answered.set())
        if not answered.wait(None if timeout_sec is None or timeout_sec < 0 else timeout_sec):
            self.remove_pending_request(future)
            return None
        return future.result()

    def call_async(self, request: Any) -> Future:
        if not isinstance(request, self.srv_type.Request):
            raise TypeError(f"Expected {self.srv_type.Request}, got {type(request)}")
        future = Future()
        with self._lock:
            number = next(self._numbers)
            self._pending[number] = future
        future.add_done_callback(self.remove_pending_request)
        self._endpoint.ask(request, number)
        return future

    def get_pending_request(self, sequence_number: int) -> Future:
        with self._lock:
            return self._pending[sequence_number]

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

    @property
    def service_name(self) -> str:
        return self.srv_name

    def destroy(self) -> None:
        self._endpoint.close()

    configure_introspection = unsupported("Client.configure_introspection")
    handle = property(unsupported("Client.handle"))

    def _take(self) -> Callable[[], Any] | None:
        sample = self._reader.take()
        if sample is None:
            return None
        try:
            (client_id, number), response = self._endpoint.decode(sample[0], self.srv_type.Response.TYPENAME)
        except ValueError as error:
            get_logger("rclpy").error(f"dropped an answer of {self.srv_name}: {error}")
            return None
        with self._lock:
            future = self._pending.get(number)
        if client_id != self._endpoint.client_id or future is None:
            return None  # the answer to another client, or to a call that was given up
        return lambda: future.set_result(response)
