"""Topics live for Foxglove and Lichtblick, by Foxglove's own WebSocket protocol, without ROS 2: bytes are handed on as they come.

Which topics there are and how their messages come is others' matter.
"""

from __future__ import annotations

from threading import Lock
from typing import Any

import foxglove
from foxglove.websocket import ServerListener

from quadvel_recordings.definitions import STORE

from .guard import is_loopback
from .server import AddressError

PORT = 8765
"""TCP port at which Foxglove looks first"""


class FoxgloveServer:
    """Serves from the time it is made until `close`.

    Raises AddressError where address and port can't be listened on, and for the address of another interface than the
    loopback one: whoever reaches this server sees all topics, and it asks nobody who he is.
    """

    def __init__(self, host: str, port: int) -> None:
        if not is_loopback(host):
            raise AddressError(
                f"{host}: topics are served to this host alone, as Foxglove shows no token; come by ssh -L {port}:127.0.0.1:{port}"
            )
        self._channels: dict[str, foxglove.Channel] = {}
        self._kept: dict[str, bytes] = {}
        self._latched: set[str] = set()
        self._lock = Lock()
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name="quadvel", host=host, port=port, context=self._context, server_listener=_Latch(self)
            )
        except Exception as error:
            raise AddressError(f"{host}:{port}: the topics can't be served there: {error}") from None
        self.url = f"ws://{host}:{self._server.port}"

    def offer(self, topic: str, typename: str, latched: bool = False) -> None:
        """Offer a topic of a type that is known. latched: its last message is for those, too, who come later."""
        text, _ = STORE.generate_msgdef(typename, ros_version=2)
        schema = foxglove.Schema(name=typename, encoding="ros2msg", data=text.encode())
        with self._lock:
            self._channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=self._context
            )
            if latched:
                self._latched.add(topic)

    def tell(self, topic: str, data: bytes, time: int) -> None:
        """A message of a topic that is offered, and when it was sent, ns."""
        if topic in self._latched:
            with self._lock:
                self._kept[topic] = data
        self._channels[topic].log(data, log_time=time)

    def again(self, topic: str) -> None:
        """Tell once more what was kept of a topic: to all, as the library names no client."""
        with self._lock:
            data = self._kept.get(topic)
        if data is not None:
            self._channels[topic].log(data)

    def close(self) -> None:
        """End all connections."""
        self._server.stop()


class _Latch(ServerListener):
    """Sends what was published once to those who come later."""

    def __init__(self, server: FoxgloveServer) -> None:
        self._latching = server

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """A client wants a topic."""
        self._latching.again(channel.topic)
