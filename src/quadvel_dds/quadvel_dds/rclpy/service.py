"""Services.

`wire.CallEndpoint` encodes and sends; `client` is the other side; the executor runs the callback.
"""

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

CLIENT_TIMEOUT_S = 0.5
"""Time in which the reader of a requesting client must be discovered."""
RETRY_PERIOD_NS = 5_000_000


class Service(Partial):
    """Service, see rclpy's Service.

    Attributes:
        srv_type: Class of the service.
        service_name: Full name of the service.
        callback: Called with request and response.
        qos_profile: QoS profile.
    """

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
        # Responses whose client is not connected yet, with their deadlines; a timer retries.
        self._waiting: list[tuple[float, Any, Any]] = []
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._retry_timer = Timer(self._retry_responses, None, RETRY_PERIOD_NS, steady, autostart=False)

    def send_response(self, response: Any, header: Any) -> None:
        """Send a response; if the client is not connected yet, retry for `CLIENT_TIMEOUT_S`.

        Args:
            response: The response.
            header: Request id and client, as received.

        Raises:
            TypeError: The response has another type.
        """
        if not isinstance(response, self.srv_type.Response):
            where, expected = f"service {self.service_name}", self.srv_type.Response.TYPENAME
            raise TypeError(f"{where}: the callback returned {response!r}, expected {expected}")
        if not self._endpoint.answer(response, *header):
            self._waiting.append((time.monotonic() + CLIENT_TIMEOUT_S, response, header))
            self._retry_timer.reset()

    def _retry_responses(self) -> None:
        """Retry to send waiting responses."""
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
            self._retry_timer.cancel()

    def destroy(self) -> None:
        """Delete the endpoint; `Node.destroy_service` calls this."""
        self._waiting.clear()
        self._retry_timer.destroy()
        self._endpoint.close()

    def _take(self) -> Callable[[], Any] | None:
        """Return a call that answers a received request, or None."""
        sample = self._reader.take()
        if sample is None:
            return None
        data, info = sample
        client = self._reader.writer_of(info)
        if client is None:
            return None  # the client has left already
        try:
            if not self._endpoint.understands(client):
                raise ValueError("it came by Fast DDS, whose calls the embedded middleware can not answer")
            request_id, request = self._endpoint.decode(data, self.srv_type.Request.TYPENAME)
        except ValueError as error:
            get_logger("rclpy").error(f"service {self.service_name}: dropped a request: {error}")
            return None
        response = self.srv_type.Response()
        return lambda: self.send_response(self.callback(request, response), (request_id, client))
