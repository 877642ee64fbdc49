"""Service clients: send requests, and complete a future for each response.

`wire.CallEndpoint` encodes and sends; `service` is the other side; the executor takes responses
from a client and completes the futures while the node spins.
"""

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

SERVICE_POLL_PERIOD_S = 0.01
"""Time between two checks for a service, s."""


class Client(Partial):
    """Client of a service, see rclpy's Client.

    Attributes:
        context: Context of the node.
        srv_type: Class of the service.
        service_name: Full name of the service.
        qos_profile: QoS profile.
    """

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
        self._number_of: dict[Future, int] = {}  # the other way round: many requests may be pending
        self._lock = Lock()

    def call_async(self, request: Any) -> Future:
        """Send a request.

        Args:
            request: The request.

        Returns:
            Future of the response; it completes while the node spins.

        Raises:
            TypeError: The request has another type.
        """
        if not isinstance(request, self.srv_type.Request):
            raise TypeError(f"Expected {self.srv_type.Request}, got {type(request)}")
        future = Future()
        with self._lock:
            number = next(self._numbers)
            self._pending[number] = future
            self._number_of[future] = number
        future.add_done_callback(self.remove_pending_request)
        self._endpoint.ask(request, number)
        return future

    def remove_pending_request(self, future: Future) -> None:
        """Forget a request, so that its response is ignored.

        Args:
            future: Future that `call_async` returned for the request.
        """
        with self._lock:
            number = self._number_of.pop(future, None)
            if number is not None:
                del self._pending[number]

    def service_is_ready(self) -> bool:
        """Return whether a service is connected.

        Returns:
            Whether requests reach a service.
        """
        return self._endpoint.is_matched()

    def wait_for_service(self, timeout_sec: float | None = None) -> bool:
        """Wait until a service is connected.

        Args:
            timeout_sec: Timeout, s; None or negative: unlimited.

        Returns:
            Whether a service is connected.
        """
        deadline = None if timeout_sec is None or timeout_sec < 0 else time.monotonic() + timeout_sec
        while self.context.ok() and not self.service_is_ready():
            if deadline is not None and time.monotonic() >= deadline:
                return False
            time.sleep(SERVICE_POLL_PERIOD_S)
        return self.service_is_ready()

    def destroy(self) -> None:
        """Delete the endpoint; `Node.destroy_client` calls this."""
        self._endpoint.close()

    def _take(self) -> Callable[[], Any] | None:
        """Take one response; return a function that completes its future, or None.

        None stands for: no response, a damaged one, or one that this client does not wait for.
        """
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
            return None  # the response to another client, or to a removed request
        return lambda: future.set_result(response)
