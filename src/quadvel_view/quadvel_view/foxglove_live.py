"""Live topics for Foxglove and Lichtblick by Foxglove's WebSocket protocol, without ROS 2.

Serialised messages are forwarded unchanged. `quadvel_bringup.foxglove` supplies them.
"""

from __future__ import annotations

from threading import Lock
from typing import Any

import foxglove
from foxglove.websocket import ServerListener

from quadvel_recordings.definitions import STORE

from .access_control import is_loopback
from .server import AddressError

DEFAULT_PORT = 8765
"""TCP port that Foxglove suggests."""


class FoxgloveServer:
    """Serves topics from construction until `close`.

    It listens on the loopback interface only, because there is no authentication.

    Args:
        host: Address of the loopback interface.
        port: TCP port.

    Raises:
        AddressError: The address is unavailable, or not that of the loopback interface.
    """

    def __init__(self, host: str, port: int) -> None:
        if not is_loopback(host):
            raise AddressError(
                f"{host}: Foxglove has no authentication, so topics are served to this computer only; "
                f"from others use ssh -L {port}:127.0.0.1:{port}"
            )
        self._channels: dict[str, foxglove.Channel] = {}
        self._kept: dict[str, bytes] = {}
        self._latched: set[str] = set()
        self._lock = Lock()
        # The SDK logs what a client sends as it came, and any web page is a client: escape sequences
        # would reach the terminal. Only its first call counts.
        foxglove.set_log_level("CRITICAL")
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name="quadvel", host=host, port=port, context=self._context, server_listener=_Latch(self)
            )
        except Exception as error:
            advice = (
                "; `quadvel view --foxglove --port NUMBER` takes another one"
                if "in use" in str(error)
                else ""
            )
            raise AddressError(f"{host}:{port}: cannot serve the topics: {error}{advice}") from None
        self.url = f"ws://{host}:{self._server.port}"

    def offer(self, topic: str, typename: str, latched: bool = False) -> None:
        """Offer a topic.

        Args:
            topic: The topic.
            typename: Its type, which `STORE` defines.
            latched: Whether late subscribers get its last message.
        """
        text, _ = STORE.generate_msgdef(typename, ros_version=2)
        schema = foxglove.Schema(name=typename, encoding="ros2msg", data=text.encode())
        with self._lock:
            self._channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=self._context
            )
            if latched:
                self._latched.add(topic)

    def publish(self, topic: str, data: bytes, time: int) -> None:
        """Send a message of an offered topic.

        Args:
            topic: The topic.
            data: The message in CDR.
            time: When it was sent, ns.
        """
        if topic in self._latched:
            with self._lock:
                self._kept[topic] = data
        self._channels[topic].log(data, log_time=time)

    def republish(self, topic: str) -> None:
        """Send the latched message of a topic again, to all clients.

        The library cannot address one.

        Args:
            topic: The topic.
        """
        with self._lock:
            data = self._kept.get(topic)
        if data is not None:
            self._channels[topic].log(data)

    def close(self) -> None:
        """Close all connections."""
        self._server.stop()


class _Latch(ServerListener):
    """Sends latched messages to late subscribers."""

    def __init__(self, server: FoxgloveServer) -> None:
        self._latching = server

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Repeat the latched message of a topic.

        Args:
            client: The subscriber.
            channel: The subscribed channel.
        """
        self._latching.republish(channel.topic)
