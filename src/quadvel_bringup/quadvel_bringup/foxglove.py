"""`quadvel view --foxglove`: all topics live for Foxglove and Lichtblick.

Needs `rclpy`: ROS 2's own, or the embedded one after `quadvel_dds.install()`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from quadvel_nodes.scheduling import run_after_others
from quadvel_recordings.definitions import STORE
from quadvel_view.foxglove_live import FoxgloveServer

from .processes import StopSignals
from .recorder import ANY_QOS, HIDDEN, LATCHED_QOS
from .recording_file import LATCHED
from .session import Session

DISCOVERY_PERIOD_S = 0.5
"""Time between two searches for new topics."""
NICENESS = 5
"""Nice value: about a third of the CPU time of a robot process under load."""


def serve(host: str, port: int) -> None:
    """Forward all topics until Ctrl-C. AddressError passes through.

    Args:
        host: Address of the loopback interface.
        port: TCP port.
    """
    run_after_others(NICENESS)
    with StopSignals() as signals, Session("foxglove", rights="foxglove") as session:
        server = FoxgloveServer(host, port)
        try:
            print(f"open {server.url} in Foxglove: Open connection, Foxglove WebSocket", flush=True)
            offered: set[str] = set()
            while not signals.received:
                _offer_new(session, server, offered)
                session.spin_until(lambda: signals.received, DISCOVERY_PERIOD_S)
        finally:
            server.close()


def _offer_new(session: Session, server: FoxgloveServer, offered: set[str]) -> None:
    """Subscribe to new topics and offer them."""
    for topic, (typename, *_) in session.node.get_topic_names_and_types():
        if topic in offered or topic in HIDDEN or typename not in STORE.fielddefs:
            continue
        offered.add(topic)
        server.offer(topic, typename, latched=topic in LATCHED)
        package, kind, name = typename.split("/")
        session.node.create_subscription(
            getattr(import_module(f"{package}.{kind}"), name),
            topic,
            _forwarder(server, topic),
            LATCHED_QOS if topic in LATCHED else ANY_QOS,
            raw=True,
        )


def _forwarder(server: FoxgloveServer, topic: str) -> Callable[[bytes, dict[str, int]], Any]:
    """Return a callback that forwards the messages of a topic."""
    return lambda data, info: server.publish(topic, data, info["source_timestamp"])
