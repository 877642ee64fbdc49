"""Who may reach the page: this host's own pages, and elsewhere who shows the token."""

from __future__ import annotations

import http.client
import logging
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from socket import create_connection as raw_socket
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import ConnectionClosed, ConnectionClosedError, InvalidMessage, InvalidStatus
from websockets.frames import CloseCode
from websockets.sync.client import connect
from websockets.sync.server import unix_serve

from quadvel_view.page_protocol import MAX_MESSAGE_BYTES, LetGo, Stop
from quadvel_view.server import LOG, MAX_FRAGMENTS, MAX_SOCKETS, AddressError, PageServer

NOWHERE = Path("/nowhere")
TEXT, CONTINUED, END, MASKED = 1, 0, 0x80, 0x80  # of RFC 6455, 5.2


@pytest.fixture
def heard() -> list[Any]:
    return []


def serve(host: str, heard: list[Any]) -> Iterator[PageServer]:
    server = PageServer(
        host, 0, NOWHERE, lambda page, word: heard.append(word), lambda page: heard.append("left")
    )
    yield server
    server.close()


@pytest.fixture
def here(heard: list[Any]) -> Iterator[PageServer]:
    yield from serve("127.0.0.1", heard)


@pytest.fixture
def everywhere(heard: list[Any]) -> Iterator[PageServer]:
    yield from serve("0.0.0.0", heard)


def get(server: PageServer, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Status, headers, and body of what the server answers on the loopback interface."""
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(server.url).port, timeout=10.0)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, dict(answer.getheaders()), answer.read()


def socket(server: PageServer, origin: str | None = None, **headers: str) -> Any:
    port = urlsplit(server.url).port
    return connect(f"ws://127.0.0.1:{port}/words", origin=origin, additional_headers=headers)


def test_on_this_host_the_page_comes_without_a_token(here: PageServer) -> None:
    status, headers, body = get(here, "/")
    assert status == 200
    assert b"STOP" in body
    assert "connect-src 'self'" in headers["Content-Security-Policy"]
    assert "token" not in here.url


@pytest.mark.parametrize("host", ["robot.example:80", "192.168.1.20", "127.0.0.1.example"])
def test_a_name_that_somebody_else_lets_point_here_is_refused(here: PageServer, host: str) -> None:
    status, _, body = get(here, "/", Host=host)
    assert status == 403
    assert b"this computer only" in body


@pytest.mark.parametrize("origin", [None, "https://example.com", "http://127.0.0.1:1"])
def test_a_page_from_elsewhere_may_not_command_the_robot(here: PageServer, origin: str | None) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        socket(here, origin)


def test_our_own_page_may(here: PageServer, heard: list[Any]) -> None:
    with socket(here, f"http://127.0.0.1:{urlsplit(here.url).port}") as page:
        page.send('{"do":"stop"}')
        page.send('{"do":"let_go"}')
        page.ping().wait(10.0)
    until = time.monotonic() + 10.0
    while "left" not in heard and time.monotonic() < until:
        time.sleep(0.01)
    assert heard == [Stop(), LetGo(), "left"]


def test_many_pages_are_refused_and_those_that_are_open_go_on(here: PageServer, heard: list[Any]) -> None:
    ours = f"http://127.0.0.1:{urlsplit(here.url).port}"
    with ExitStack() as open_pages:
        pages = [open_pages.enter_context(socket(here, ours)) for _ in range(MAX_SOCKETS)]
        with pytest.raises(InvalidStatus, match="503"):
            socket(here, ours)
        pages[0].send('{"do":"stop"}')
        pages[0].ping().wait(10.0)
    assert heard[0] == Stop()
    with socket(here, ours) as page:
        page.ping().wait(10.0)


@pytest.mark.parametrize("error", [InvalidMessage("no HTTP"), ConnectionClosedError(None, None)])
def test_handshakes_that_fail_by_the_visitor_leave_no_trace_in_the_log(error: Exception) -> None:
    record = logging.LogRecord("", logging.ERROR, "", 0, "", None, (type(error), error, None))
    assert not LOG.filter(record)


def test_what_makes_no_sense_ends_the_connection(here: PageServer, heard: list[Any]) -> None:
    for nonsense in ("[1]", "{", "[" * 4000, '{"do":' * 600, b"\xff\xfe"):
        with socket(here, f"http://127.0.0.1:{urlsplit(here.url).port}") as page:
            page.send(nonsense)
            with pytest.raises(Exception, match="not understood"):
                page.recv(timeout=10.0)
    assert [word for word in heard if word != "left"] == []


def frame(opcode: int, data: bytes, length: int | None = None, last: bool = False) -> bytes:
    """One as a browser sends it, with a mask of zeros. length: what it says of itself, where it is not what it has."""
    head = struct.pack(
        ">BBQ", opcode | (END if last else 0), MASKED | 127, len(data) if length is None else length
    )
    return head + bytes(4) + data


@pytest.mark.parametrize(
    "frames",
    [
        frame(TEXT, b"", length=400_000_000, last=True),
        frame(TEXT, b"x" * 1000) + frame(CONTINUED, b"x" * 1000) * (MAX_MESSAGE_BYTES // 1000),
        frame(TEXT, b"") + frame(CONTINUED, b"") * MAX_FRAGMENTS,
        frame(TEXT, b"x" * 4000) + frame(CONTINUED, b"", length=2**62),
    ],
    ids=["whole", "in fragments", "in empty fragments", "in a huge last fragment"],
)
def test_a_long_message_is_refused_while_it_arrives(
    here: PageServer, heard: list[Any], frames: bytes
) -> None:
    with socket(here, f"http://127.0.0.1:{urlsplit(here.url).port}") as page:
        page.socket.sendall(frames)
        with pytest.raises(ConnectionClosed) as closed:
            page.recv(timeout=10.0)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == CloseCode.MESSAGE_TOO_BIG
    assert [word for word in heard if word != "left"] == []


def test_the_scene_refuses_a_message_in_many_fragments(tmp_path: Path) -> None:
    with ExitStack() as opened:
        scene = opened.enter_context(
            unix_serve(lambda connection: connection.recv(), str(tmp_path / "scene"))
        )
        Thread(target=scene.serve_forever, daemon=True).start()
        opened.callback(scene.shutdown)
        server = PageServer("127.0.0.1", 0, tmp_path / "scene", lambda *_: None, lambda _: None)
        opened.callback(server.close)
        port = urlsplit(server.url).port
        with connect(f"ws://127.0.0.1:{port}/scene", origin=f"http://127.0.0.1:{port}") as page:
            page.socket.sendall(frame(TEXT, b"") + frame(CONTINUED, b"") * MAX_FRAGMENTS)
            with pytest.raises(ConnectionClosed) as closed:
                page.recv(timeout=5.0)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == CloseCode.MESSAGE_TOO_BIG


def test_a_page_that_does_not_read_delays_the_end_by_little() -> None:
    server = PageServer("127.0.0.1", 0, NOWHERE, lambda *_: None, lambda _: None)
    with raw_socket(("127.0.0.1", urlsplit(server.url).port), 10.0) as page:
        name = f"127.0.0.1:{urlsplit(server.url).port}"
        page.sendall(
            f"GET /words HTTP/1.1\r\nHost: {name}\r\nOrigin: http://{name}\r\nUpgrade: websocket\r\n"
            "Connection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
            "Sec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        until = time.monotonic() + 10.0
        while not server.is_watched and time.monotonic() < until:
            time.sleep(0.01)
        start = time.monotonic()
        server.close()
        assert time.monotonic() - start < 5.0


def test_elsewhere_only_the_token_lets_in(everywhere: PageServer) -> None:
    token = urlsplit(everywhere.url).query.partition("=")[2]
    assert len(token) >= 20
    assert urlsplit(everywhere.url).hostname not in ("0.0.0.0", "", None)  # a browser elsewhere opens it
    for path in ("/", "/app.js", "/scene/", "/?token=wrong", f"/?token={token[:-1]}"):
        assert get(everywhere, path)[0] == 403
    with pytest.raises(InvalidStatus, match="403"):
        socket(everywhere, f"http://127.0.0.1:{urlsplit(everywhere.url).port}")
    status, headers, _ = get(everywhere, f"/?token={token}")
    assert status == 200
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert "HttpOnly" in headers["Set-Cookie"]
    assert get(everywhere, "/app.js", Cookie=cookie)[0] == 200
    with socket(everywhere, f"http://127.0.0.1:{urlsplit(everywhere.url).port}", Cookie=cookie) as page:
        page.ping().wait(10.0)


def test_a_port_that_is_taken_is_told_in_one_sentence(here: PageServer) -> None:
    port = urlsplit(here.url).port
    assert port is not None
    with pytest.raises(AddressError, match=rf"127.0.0.1:{port}: cannot serve the page: .*--port"):
        PageServer("127.0.0.1", port, NOWHERE, lambda page, word: None, lambda page: None)


@pytest.mark.parametrize(("host", "port"), [("127.0.0.1", 99999), ("127.0.0.1", -1), ("a" * 300, 0), ("", 0)])
def test_an_address_that_does_not_exist_is_told_and_not_waited_for(host: str, port: int) -> None:
    with pytest.raises(AddressError):
        PageServer(host, port, NOWHERE, lambda page, word: None, lambda page: None)


def test_floods_from_some_pages_delay_the_stop_of_another_by_few_orders(
    here: PageServer, heard: list[Any]
) -> None:
    ours = f"http://127.0.0.1:{urlsplit(here.url).port}"
    flood = frame(TEXT, b'{"do":"let_go"}', last=True) * 20_000
    with ExitStack() as open_pages:
        pages = [open_pages.enter_context(socket(here, ours)) for _ in range(5)]
        senders = [Thread(target=page.socket.sendall, args=(flood,)) for page in pages[1:]]
        for sender in senders:
            sender.start()
        until = time.monotonic() + 20.0
        while len(heard) < 1000 and time.monotonic() < until:
            time.sleep(0.001)
        before = len(heard)
        pages[0].send('{"do":"stop"}')
        for sender in senders:
            sender.join()
        while Stop() not in heard and time.monotonic() < until:
            time.sleep(0.01)
    assert heard.index(Stop()) - before < 5_000
