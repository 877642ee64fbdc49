"""Services: answers to requests."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from quadvel_dds import wire
from quadvel_dds.errors import Partial

from .clock import Clock
from .logging import get_logger
from .time import ClockType
from .timer import Timer

PATIENCE = 0.5  # s, in which the reader of a client that asked must be found
LOOK = 5_000_000  # ns, between two looks for it


class Service(Partial):
    def __init__(
        self, service_impl: wire.CallEndpoint, srv_type: Any, srv_name: str,
        callback: Callable[[Any, Any], Any], callback_group: Any, qos_profile: Any,
    ) -> None:  # fmt: skip
        self._endpoint = service_impl
        self._reader = service_impl.reader
        self.srv_type = srv_type
        self.service_name = srv_name
        self.callback = callback
        self.qos_profile = qos_profile
        # Answers whose client was not found yet, and until when it is looked for; the timer runs while there are any.
        self._waiting: list[tuple[float, Any, Any]] = []
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._look = Timer(self._try_again, None, LOOK, steady, autostart=False)

    def send_response(self, response: Any, header: Any) -> None:
        """Send the answer to the request that came with `header`; later, if the client is not found yet."""
        if not isinstance(response, self.srv_type.Response):
            where, expected = f"service {self.service_name}", self.srv_type.Response.TYPENAME
            raise TypeError(f"{where}: the callback returned {response!r}, expected {expected}")
        if not self._endpoint.answer(response, *header):
            self._waiting.append((time.monotonic() + PATIENCE, response, header))
            self._look.reset()

    def _try_again(self) -> None:
        waiting, self._waiting = self._waiting, []
        for until, response, header in waiting:
            if self._endpoint.answer(response, *header):
                continue
            if time.monotonic() < until:
                self._waiting.append((until, response, header))
            else:
                text = f"service {self.service_name}: a client that asked does not listen"
                get_logger("rclpy").warning(text)
        if not self._waiting:
            self._look.cancel()

    def destroy(self) -> None:
        self._waiting.clear()
        self._look.destroy()
        self._endpoint.close()

    def _take(self) -> Callable[[], Any] | None:
        sample = self._reader.take()
        if sample is None:
            return None
        data, info = sample
        client = self._reader.writer_of(info)
        if client is None:
            return None  # it left before it was heard
        try:
            if not self._endpoint.understands(client):
                raise ValueError("it came by Fast DDS, whose calls the embedded middleware can not answer")
            request_id, request = self._endpoint.decode(data, self.srv_type.Request.TYPENAME)
        except ValueError as error:
            get_logger("rclpy").error(f"service {self.service_name}: dropped a request: {error}")
            return None
        response = self.srv_type.Response()
        return lambda: self.send_response(self.callback(request, response), (request_id, client))
