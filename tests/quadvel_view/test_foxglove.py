"""Topics as Foxglove's protocol has them: offered with their definitions, and handed on as they came."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from importlib.resources import files

import pytest
from websockets.sync.client import connect

from quadvel_recordings.definitions import STORE
from quadvel_view.server import AddressError

from .conftest import odometry

foxglove_live = pytest.importorskip("quadvel_view.foxglove_live", reason="foxglove-sdk is not installed")
SUBPROTOCOLS = ["foxglove.sdk.v1", "foxglove.websocket.v1"]
ODOMETRY = "nav_msgs/msg/Odometry"


@pytest.fixture
def server() -> Iterator[foxglove_live.FoxgloveServer]:
    server = foxglove_live.FoxgloveServer("127.0.0.1", 0)
    yield server
    server.close()


def advertised(client) -> dict:
    """The first channel that the server offers."""
    while True:
        word = client.recv(timeout=10.0)
        if isinstance(word, str) and json.loads(word)["op"] == "advertise":
            return json.loads(word)["channels"][0]


@pytest.mark.parametrize("latched", [True, False])
def test_a_topic_comes_with_its_definition_and_its_bytes(server, latched: bool) -> None:
    data = bytes(STORE.serialize_cdr(odometry(1.0, 2.0), ODOMETRY))
    server.offer("/odom", ODOMETRY, latched)
    server.publish("/odom", data, 1)
    with connect(server.url, subprotocols=SUBPROTOCOLS) as client:
        channel = advertised(client)
        assert (channel["topic"], channel["encoding"], channel["schemaName"]) == ("/odom", "cdr", ODOMETRY)
        assert "geometry_msgs/Point position" in channel["schema"]
        wanted = {"op": "subscribe", "subscriptions": [{"id": 7, "channelId": channel["id"]}]}
        client.send(json.dumps(wanted))
        if not latched:
            with pytest.raises(TimeoutError):
                client.recv(timeout=0.3)
            server.publish("/odom", data, 2)
        assert client.recv(timeout=10.0)[13:] == data  # behind operation, subscription, and time


def test_a_page_of_another_origin_sees_topics_and_publishes_nothing(server) -> None:
    """The one exception: Foxglove's own page is of another origin."""
    server.offer("/odom", ODOMETRY)
    with connect(server.url, origin="https://app.foxglove.dev", subprotocols=SUBPROTOCOLS) as client:
        assert json.loads(client.recv(timeout=10.0))["capabilities"] == []
        assert advertised(client)["topic"] == "/odom"
        channel = {"id": 1, "topic": "/cmd_vel", "encoding": "json", "schemaName": "geometry_msgs/msg/Twist"}
        client.send(json.dumps({"op": "advertise", "channels": [channel]}))
        assert "clientPublish" in json.loads(client.recv(timeout=10.0))["message"]


def test_nothing_that_a_page_sends_reaches_the_terminal() -> None:
    """In another process, because the log of the SDK is set once."""
    program = """
import time
from websockets.sync.client import connect
from quadvel_view.foxglove_live import FoxgloveServer

server = FoxgloveServer("127.0.0.1", 0)
with connect(server.url, subprotocols=["foxglove.sdk.v1"], origin="https://example.com") as client:
    client.send('{"op":"subscribe\x1b[31m"}')
    client.ping().wait(10.0)
server.close()
"""
    environment = {name: value for name, value in os.environ.items() if name != "FOXGLOVE_LOG_LEVEL"}
    ran = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, timeout=60.0)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, b"", b"")


def test_other_hosts_are_refused_as_nobody_shows_a_token_here() -> None:
    with pytest.raises(AddressError, match=r"this computer only.*ssh -L"):
        foxglove_live.FoxgloveServer("0.0.0.0", 0)


def test_a_port_that_is_taken_names_the_option_for_another_one() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(AddressError, match="--port"):
        foxglove_live.FoxgloveServer("127.0.0.1", taken.getsockname()[1])


def test_the_layout_shows_the_robot_by_its_description() -> None:
    layout = json.loads(files("quadvel_view").joinpath("layouts", "foxglove.json").read_text())
    assert layout["configById"]["3D!robot"]["layers"]["urdf"]["topic"] == "/robot_description"
    shown = {layout["layout"]["first"]}
    rest = layout["layout"]["second"]
    while isinstance(rest, dict):
        shown.add(rest["first"])
        rest = rest["second"]
    assert shown | {rest} == set(layout["configById"])
