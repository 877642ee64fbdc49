"""`quadvel view --foxglove`: every topic that is there, live for Foxglove and Lichtblick.

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

LOOK = 0.5  # s, between two looks for new topics
NICENESS = 5
"""a third of the processor time of each of the robot's processes where it is short: nothing is commanded from here"""


def serve(host: str, port: int) -> None:
    """Hand on what comes, until Ctrl-C. Raises AddressError."""
    run_after_others(NICENESS)
    with StopSignals() as signals, Session("foxglove", rights="foxglove") as session:
        server = FoxgloveServer(host, port)
        try:
            print(f"open {server.url} in Foxglove: Open connection, Foxglove WebSocket", flush=True)
            offered: set[str] = set()
            while not signals.received:
                _offer_new(session, server, offered)
                session.spin_until(lambda: signals.received, LOOK)
        finally:
            server.close()


def _offer_new(session: Session, server: FoxgloveServer, offered: set[str]) -> None:
    for topic, (typename, *_) in session.node.get_topic_names_and_types():
        if topic in offered or topic in HIDDEN or typename not in STORE.fielddefs:
            continue
        offered.add(topic)
        server.offer(topic, typename, latched=topic in LATCHED)
        package, kind, name = typename.split("/")
        session.node.create_subscription(
            getattr(import_module(f"{package}.{kind}"), name),
            topic,
            _hands_on(server, topic),
            LATCHED_QOS if topic in LATCHED else ANY_QOS,
            raw=True,
        )


def _hands_on(server: FoxgloveServer, topic: str) -> Callable[[bytes, dict[str, int]], Any]:
    return lambda data, info: server.tell(topic, data, info["source_timestamp"])
