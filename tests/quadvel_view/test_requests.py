"""Requests as no browser of ours sends them: a sentence and 400, never an error of the server; and cookies that others left."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quadvel_view.server import PageServer

HERE = b"Host: 127.0.0.1"
HANDSHAKE = (
    b"Connection: Upgrade",
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    b"Sec-WebSocket-Version: 13",
)
OURS = b"Origin: http://127.0.0.1"


@pytest.fixture(scope="module")
def here() -> Iterator[PageServer]:
    server = PageServer("127.0.0.1", 0, Path("/nowhere"), lambda *_: None, lambda _: None)
    yield server
    server.close()


@pytest.fixture(scope="module")
def everywhere() -> Iterator[PageServer]:
    server = PageServer("0.0.0.0", 0, Path("/nowhere"), lambda *_: None, lambda _: None)
    yield server
    server.close()


def ask(server: PageServer, *headers: bytes, path: bytes = b"/") -> tuple[int, bytes]:
    """Status and body of the answer, or 0 where the connection ends without one."""
    with socket.create_connection(("127.0.0.1", urlsplit(server.url).port or 0), 10.0) as connection:
        connection.sendall(b"\r\n".join([b"GET " + path + b" HTTP/1.1", *headers, b"", b""]))
        answer = connection.makefile("rb")
        found = re.match(rb"HTTP/1.1 (\d{3})", answer.readline())
        if found is None or found[1] == b"101":
            return int(found[1]) if found else 0, b""
        return int(found[1]), answer.read().partition(b"\r\n\r\n")[2]


@pytest.mark.parametrize(
    ("headers", "named"),
    [
        ([b"Host: [bad"], b"Host"),
        ([b"Host: [bad]"], b"Host"),
        ([b"Host: a b"], b"Host"),
        ([b"Host: somebody@127.0.0.1"], b"Host"),
        ([b"Host: 127.0.0.1:http"], b"Host"),
        ([b"Host: \xff\xfe"], b"Host"),
        ([HERE, HERE], b"Host"),
        ([], b"Host"),
        ([HERE, b"Upgrade: websocket", b"Upgrade: websocket", *HANDSHAKE, OURS], b"Upgrade"),
        ([HERE, b"Upgrade: websocket", *HANDSHAKE, OURS, OURS], b"Origin"),
    ],
)
def test_a_header_that_makes_no_sense_is_named(here: PageServer, headers: list[bytes], named: bytes) -> None:
    status, body = ask(here, *headers, path=b"/words")
    assert status == 400
    assert body.startswith(named)
    assert body.count(b"\n") == 1


@pytest.mark.parametrize(
    "named",
    [
        b"Connection",
        b"Sec-WebSocket-Key",
        b"Sec-WebSocket-Version",
        b"Sec-WebSocket-Extensions",
        b"Sec-WebSocket-Protocol",
    ],
)
def test_bytes_in_a_header_of_the_handshake_are_named_and_no_error_of_the_server(
    here: PageServer, named: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    others = [header for header in HANDSHAKE if not header.startswith(named + b":")]
    headers = [HERE, b"Upgrade: websocket", *others, OURS, named + b": \xff"]
    status, body = ask(here, *headers, path=b"/words")
    assert status == 400
    assert body.startswith(named)
    assert not caplog.records


def test_a_path_that_makes_no_sense_is_named(here: PageServer) -> None:
    status, body = ask(here, HERE, path=b"//[bad")
    assert status == 400
    assert b"//[bad" in body


@pytest.mark.parametrize(
    "origin",
    [b"http://[bad", b"null", b"\xff", b"http://127.0.0.1@evil.example", b"http://127.0.0.1.evil.example"],
)
def test_an_origin_that_makes_no_sense_is_one_from_elsewhere(here: PageServer, origin: bytes) -> None:
    status, _ = ask(here, HERE, b"Upgrade: websocket", *HANDSHAKE, b"Origin: " + origin, path=b"/words")
    assert status == 403


@pytest.mark.parametrize("name", [b"127.0.0.1", b"127.0.0.1:8770", b"localhost:1", b"[::1]:8770"])
def test_each_name_of_this_host_comes_in_and_its_own_pages_connect(here: PageServer, name: bytes) -> None:
    handshake = [b"Upgrade: WebSocket", *HANDSHAKE, b"Origin: http://" + name]
    assert ask(here, b"Host: " + name)[0] == 200
    assert ask(here, b"Host: " + name, *handshake, path=b"/words")[0] == 101


@pytest.mark.parametrize(
    "others",
    [
        [b'settings={"a": [1, 2], "b": "x"}'],
        [b"bad(name)=1; a,b=2; =; ;x"],
        [b'open="; quote=\xff'],
        [b"first=1", b"second=2"],
        [b"quadvel_view_0=stale"],
    ],
    ids=["JSON", "names that are none", "an open quote and bytes", "two headers", "another of ours"],
)
@pytest.mark.parametrize("ours_first", [True, False])
def test_cookies_of_other_programs_on_the_host_keep_nobody_out(
    everywhere: PageServer, others: list[bytes], ours_first: bool
) -> None:
    token = urlsplit(everywhere.url).query.removeprefix("token=").encode()
    ours = b"quadvel_view=" + token
    in_one = b"; ".join([ours, *others] if ours_first else [*others, ours])
    several = [b"Cookie: " + one for one in ([ours, *others] if ours_first else [*others, ours])]
    assert ask(everywhere, HERE, b"Cookie: " + in_one, path=b"/app.js")[0] == 200
    assert ask(everywhere, HERE, *several, path=b"/app.js")[0] == 200
    assert ask(everywhere, HERE, *(b"Cookie: " + one for one in others), path=b"/app.js")[0] == 403


def test_two_pages_on_one_host_have_a_cookie_each(everywhere: PageServer) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    other = PageServer("0.0.0.0", port, Path("/nowhere"), lambda *_: None, lambda _: None)
    try:
        cookies = [given_cookie(server) for server in (everywhere, other)]
    finally:
        other.close()
    assert len({cookie.partition(b"=")[0] for cookie in cookies}) == 2


def given_cookie(server: PageServer) -> bytes:
    """The cookie that the page sets for who shows the token."""
    address = urlsplit(server.url)
    with socket.create_connection(("127.0.0.1", address.port or 0), 10.0) as connection:
        connection.sendall(f"GET /?{address.query} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        found = re.search(rb"Set-Cookie: (.*?);", connection.makefile("rb").read())
    assert found is not None
    return found[1]


NAMES = st.sampled_from(["Host", "Origin", "Upgrade", "Connection", "Cookie", "Sec-WebSocket-Key", "Accept"])
VALUES = st.one_of(
    st.sampled_from(["127.0.0.1", "localhost", "websocket", "http://127.0.0.1", "[", "]", "quadvel_view_0="]),
    st.text(st.characters(min_codepoint=32, max_codepoint=255, exclude_characters="\x7f"), max_size=20),
)
PATHS = st.text(st.characters(min_codepoint=33, max_codepoint=255, exclude_characters="\x7f"), max_size=20)


@settings(max_examples=150)
@given(headers=st.lists(st.tuples(NAMES, VALUES), max_size=6), path=PATHS, with_host=st.booleans())
@pytest.mark.parametrize("where", ["here", "everywhere"])
def test_no_request_is_an_error_of_the_server(
    where: str,
    here: PageServer,
    everywhere: PageServer,
    headers: list[tuple[str, str]],
    path: str,
    with_host: bool,
) -> None:
    lines = [f"{name}: {value}".encode("latin-1") for name, value in headers]
    status, body = ask(
        here if where == "here" else everywhere,
        *([HERE] if with_host else []),
        *lines,
        path=b"/" + path.encode("latin-1"),
    )
    assert status < 500
    assert body or status in (0, 101)


@pytest.mark.parametrize(
    "others",
    [[b"a=" + b"x" * 60_000], [b"a=" + b"x" * 30_000, b"b=" + b"y" * 30_000]],
    ids=["in one header", "in two headers"],
)
def test_long_cookies_of_other_programs_on_the_host_keep_nobody_out(
    here: PageServer, others: list[bytes]
) -> None:
    cookies = [b"Cookie: " + one for one in others]
    assert ask(here, HERE, *cookies)[0] == 200
    assert ask(here, HERE, b"Upgrade: websocket", *HANDSHAKE, OURS, *cookies, path=b"/words")[0] == 101


def test_a_request_with_more_headers_than_any_browser_sends_is_not_kept_in_memory(here: PageServer) -> None:
    headers = [HERE, *(b"X: " + b"x" * 60_000 for _ in range(100))]
    with pytest.raises(ConnectionError):
        ask(here, *headers)
