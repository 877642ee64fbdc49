"""Services: answers to requests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from quadvel_dds import wire
from quadvel_dds.errors import unsupported

from .logging import get_logger


class Service:
    def __init__(
        self,
        service_impl: wire.CallEndpoint,
        srv_type: Any,
        srv_name: str,
        callback: Callable[[Any, Any], Any],
        callback_group: Any,
        qos_profile: Any,
    ) -> None:
        self._endpoint = service_impl
        self._reader = service_impl.reader
        self.srv_type = srv_type
        self.srv_name = srv_name
        self.callback = callback
        self.callback_group = callback_group
        self.qos_profile = qos_profile

    @property
    def service_name(self) -> str:
        return self.srv_name

    def send_response(self, response: Any, header: Any) -> None:
        """Send the answer to the request that came with `header`."""
        if not isinstance(response, self.srv_type.Response):
            expected = self.srv_type.Response.TYPENAME
            raise TypeError(
                f"service {self.srv_name}: the callback returned {response!r}, expected {expected}"
            )
        request_id, client = header
        if client is None:
            return  # the client left before its answer
        if not self._endpoint.answer(response, request_id, client):
            get_logger("rclpy").warning(f"service {self.srv_name}: a client that asked does not listen")

    def destroy(self) -> None:
        self._endpoint.close()

    configure_introspection = unsupported("Service.configure_introspection")
    handle = property(unsupported("Service.handle"))

    def _take(self) -> Callable[[], Any] | None:
        sample = self._reader.take()
        if sample is None:
            return None
        data, info = sample
        try:
            request_id, request = self._endpoint.decode(data, self.srv_type.Request.TYPENAME)
        except ValueError as error:
            get_logger("rclpy").error(f"dropped a request to {self.srv_name}: {error}")
            return None
        header = (request_id, self._reader.writer_of(info))
        return lambda: self.send_response(self.callback(request, self.srv_type.Response()), header)
