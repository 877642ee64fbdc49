"""Web server of the page, its messages in both directions, and viser's scene on the same port.

The scene is one-way: viser's messages are forwarded to the browser, and the browser's messages to
viser are dropped. `AccessControl` checks token, Host and Origin of each request.

A page opened as 127.0.0.1 embeds the scene from localhost, and vice versa. To the browser these are
two sites, which it renders in two processes: drawing never delays the pad and the STOP. With a token
both have the same name, because the browser sends the token's cookie only to the name that
set it.
"""

from __future__ import annotations

import asyncio
import errno
import json
import logging
import secrets
import socket
from collections.abc import Callable
from functools import cached_property
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from threading import Event, Thread
from typing import Any
from urllib.parse import urlsplit

from websockets import http11
from websockets.asyncio.client import ClientConnection, unix_connect
from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.frames import CloseCode
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from . import scene_server
from .access_control import AccessControl, RequestError, Visitor, is_loopback, reachable_host
from .page_protocol import MAX_MESSAGE_BYTES, PageMessage, PageMessageError, parse_message

COOKIE = "quadvel_view"
"""Prefix of the name of the token's cookie.

The port follows, because browsers send cookies to all ports of a host.
"""
CONTENT_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
PAGE_FILES = {"/": "index.html", "/style.css": "style.css", "/app.js": "app.js"}
SCENE_PATH, MESSAGES_PATH = "/scene", "/words"
SCENE_FRAME, WITH_TOKEN = b'<iframe id="scene"', b" data-with-token"
"""Attribute of the scene's frame that shows the page that a token exists.

Its script cannot read the cookie.
"""
MAX_FRAGMENTS = 16
"""Largest number of fragments of a message.

Browsers send MAX_MESSAGE_BYTES in one, and even empty ones cost memory.
"""
MAX_SOCKETS = 32
"""Largest number of connections, two per page.

Each one delays the messages of the others, including STOP.
"""
MAX_HEADER_LINE_BYTES = 65_536
"""Largest size of a header line of a request.

A browser sends the cookies of all programs on this host in one line, which may be long.
"""
MAX_REQUEST_BYTES = 2 * MAX_HEADER_LINE_BYTES
"""Largest size of a request with all its headers."""
RECEIVE_BUFFER_BYTES = 2304
"""Size of the system's buffer for what a connection has received: the smallest of Linux.

The server parses such a buffer in one go. A flood from one page delays STOP of another by the time
for one buffer.
"""
CLOSE_TIMEOUT_S = 1.0
"""Time for a browser to answer the end of its connection; a slow one does not delay Ctrl-C more."""
# Hide everything of viser's page but the canvas. viser reconnects only while it has the focus,
# which our page keeps.
CANVAS_ONLY = (
    b"<style>body *{visibility:hidden!important}canvas{visibility:visible!important}</style>"
    b"<script>document.hasFocus = () => true;"
    b"new MutationObserver((_, self) => { if (document.querySelector('canvas')) { self.disconnect();"
    b"parent.postMessage('drawn', '*'); } }).observe(document, { childList: true, subtree: true });</script>"
)


class AddressError(ValueError):
    """The page cannot be served at this address; one sentence."""


def _is_server_error(record: logging.LogRecord) -> bool:
    """Return whether a log record is more than a failed handshake, which any client can cause."""
    return not (record.exc_info and isinstance(record.exc_info[1], InvalidHandshake | ConnectionClosed))


LOG = logging.getLogger("quadvel_view.page")
LOG.addFilter(_is_server_error)


# websockets has no argument for this limit, only an environment variable that it reads on import.
http11.MAX_LINE_LENGTH = MAX_HEADER_LINE_BYTES


class _Connection(ServerConnection):
    """A connection that ends if its request is longer than MAX_REQUEST_BYTES."""

    _received = 0

    def data_received(self, data: bytes) -> None:
        """Handle received bytes."""
        self._received += len(data)
        if self.request is None and self._received > MAX_REQUEST_BYTES:
            self.transport.abort()
        else:
            super().data_received(data)


class PageServer:
    """Serves the page from construction until `close`, in its own thread.

    Args:
        host: Address to listen on.
        port: TCP port, 0 for a free one.
        scene: Unix socket of viser.
        on_message: Receives the number of a page and its message, in the server's thread.
        on_disconnect: Receives the number of a page that disconnected, in the server's thread.

    Raises:
        AddressError: The address is unavailable.
    """

    def __init__(
        self,
        host: str,
        port: int,
        scene: Path,
        on_message: Callable[[int, PageMessage], object],
        on_disconnect: Callable[[int], None],
    ) -> None:
        if not host:
            raise AddressError(
                "host is '', expected an address such as 127.0.0.1, or 0.0.0.0 for all interfaces"
            )
        self._host, self._port, self._scene = host, port, scene
        self._on_message, self._on_disconnect = on_message, on_disconnect
        self._guard = AccessControl("" if is_loopback(host) else secrets.token_urlsafe(18))
        self._pages: set[ServerConnection] = set()
        self._count = 0
        self._ready, self._error = Event(), ""
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread = Thread(target=self._loop.run_until_complete, args=(self._serve(),), name="page")
        self._thread.start()
        self._ready.wait()
        if self._error:
            self._thread.join()
            self._loop.close()
            raise AddressError(self._error)

    @property
    def url(self) -> str:
        """Address of the page, with the token if there is one."""
        host = reachable_host(self._host)
        host = f"[{host}]" if ":" in host else host
        query = f"?token={self._guard.token}" if self._guard.token else ""
        return f"http://{host}:{self._port}/{query}"

    @property
    def is_watched(self) -> bool:
        """Whether a page is open."""
        return bool(self._pages)

    def send_to_pages(self, words: dict[str, Any]) -> None:
        """Send a message to all pages; callable from any thread.

        Args:
            words: Content for JSON.
        """
        if self._pages:
            text = json.dumps(words, separators=(",", ":"), allow_nan=False)
            self._loop.call_soon_threadsafe(lambda: broadcast(self._pages, text))

    def close(self) -> None:
        """Close all connections and end the thread."""
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()
        self._loop.close()

    async def _serve(self) -> None:
        """Serve until `close`."""
        try:
            async with serve(
                self._serve_socket,
                self._host,
                self._port,
                process_request=self._process_request,
                select_subprotocol=lambda connection, offered: offered[0] if offered else None,
                create_connection=_Connection,
                compression=None,
                max_size=MAX_MESSAGE_BYTES,
                close_timeout=CLOSE_TIMEOUT_S,
                logger=LOG,
            ) as server:
                for listening in server.sockets:  # its connections inherit the size
                    listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
                self._port = next(iter(server.sockets)).getsockname()[1]
                self._ready.set()
                await self._stop.wait()
        except (OSError, OverflowError, UnicodeError) as error:  # the latter two: invalid port or host name
            reason = getattr(error, "strerror", None) or error
            if getattr(error, "errno", None) == errno.EADDRINUSE:
                reason = "another program uses this port; `quadvel view --port NUMBER` takes another one"
            self._error = f"{self._host}:{self._port}: cannot serve the page: {reason}"
        finally:
            self._ready.set()

    def _process_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the response to a file request, or None for an accepted WebSocket."""
        try:
            visitor = self._guard.admit(request)
        except RequestError as error:
            return _text_response(error.status, str(error))
        if visitor.wants_socket:
            return self._refusal_of_socket(connection, visitor)
        if visitor.path == f"{SCENE_PATH}/":
            return _page_response("text/html", self._scene_page, visitor)
        if visitor.path not in PAGE_FILES:
            return _text_response(HTTPStatus.NOT_FOUND, "there is no such page")
        return self._file(PAGE_FILES[visitor.path], visitor)

    @staticmethod
    def _refusal_of_socket(connection: ServerConnection, visitor: Visitor) -> Response | None:
        """Return the rejection of a WebSocket, or None."""
        if visitor.path not in (SCENE_PATH, MESSAGES_PATH):
            return _text_response(HTTPStatus.NOT_FOUND, "there is no such socket")
        if len(connection.server.connections) >= MAX_SOCKETS:
            reason = f"{MAX_SOCKETS} connections are open: close another page of this robot"
            return _text_response(HTTPStatus.SERVICE_UNAVAILABLE, reason)
        return None

    def _file(self, name: str, visitor: Visitor) -> Response:
        """Return a file of the page; with a token, the main page sets its cookie."""
        body = files("quadvel_view").joinpath("page", name).read_bytes()
        with_token = visitor.path == "/" and self._guard.token
        if with_token:
            body = body.replace(SCENE_FRAME, SCENE_FRAME + WITH_TOKEN)
        response = _page_response(CONTENT_TYPES[name.rpartition(".")[2]], body, visitor)
        if with_token:
            keep = f"{COOKIE}_{self._port}={self._guard.token}; Path=/; HttpOnly; SameSite=Strict"
            response.headers["Set-Cookie"] = keep
        return response

    @cached_property
    def _scene_page(self) -> bytes:
        """The page of viser, reduced to its canvas."""
        return scene_server.client_page().replace(b"</head>", CANVAS_ONLY + b"</head>", 1)

    async def _serve_socket(self, connection: ServerConnection) -> None:
        """Serve a WebSocket of the page or of the scene."""
        assert connection.request is not None
        if urlsplit(connection.request.path).path == SCENE_PATH:
            await self._relay(connection)
        else:
            await self._receive_messages(connection)

    async def _receive_messages(self, connection: ServerConnection) -> None:
        """Receive the messages of a page until it disconnects."""
        self._count += 1
        page = self._count
        self._pages.add(connection)
        try:
            while (text := await _next_message(connection)) is not None:
                self._on_message(page, parse_message(text))
        except PageMessageError as error:
            await connection.close(1008, str(error))
        except ConnectionClosed:
            pass
        finally:
            self._pages.discard(connection)
            self._on_disconnect(page)

    async def _relay(self, browser: ServerConnection) -> None:
        """Forward viser's messages to a browser until one side disconnects.

        Drop the browser's messages.
        """
        spoken = [Subprotocol(browser.subprotocol)] if browser.subprotocol else None
        path = str(self._scene)
        async with unix_connect(
            path, "ws://viser/", subprotocols=spoken, compression=None, max_size=None
        ) as scene:
            ways = [asyncio.create_task(way) for way in (_forward(scene, browser), _discard(browser))]
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)


async def _forward(scene: ClientConnection, browser: ServerConnection) -> None:
    """Forward viser's messages to a browser."""
    try:
        async for message in scene:
            await browser.send(message)
    except ConnectionClosed:
        return


async def _discard(browser: ServerConnection) -> None:
    """Read and drop a browser's messages, so that pings are answered and its end is noticed."""
    try:
        while await _next_message(browser) is not None:
            pass
    except ConnectionClosed:
        return


async def _next_message(connection: ServerConnection) -> bytes | None:
    """Return the next message of a browser, or None after too many fragments.

    Raises ConnectionClosed at its end.
    """
    fragments = []
    async for fragment in connection.recv_streaming(decode=False):
        fragments.append(fragment)
        if len(fragments) > MAX_FRAGMENTS:
            await connection.close(CloseCode.MESSAGE_TOO_BIG, f"more than {MAX_FRAGMENTS} fragments")
            return None
    return b"".join(fragments)


def _text_response(status: HTTPStatus, sentence: str) -> Response:
    """Return a plain-text response."""
    return _response(
        status, "text/plain", f"{sentence}\n".encode(), "default-src 'none'; frame-ancestors 'none'"
    )


def _page_response(kind: str, body: bytes, visitor: Visitor) -> Response:
    """Return a file with its content security policy.

    It allows no content from other hosts. Only the page may embed the scene, and no site may embed
    the page, against clickjacking. viser's page unpacks itself, which requires 'unsafe-eval'.
    """
    ours = "'self'"
    if is_loopback(visitor.name.strip("[]")):  # page and scene have two names of the same host
        ours += "".join(f" http://{name}{visitor.port}" for name in ("127.0.0.1", "localhost"))
    ancestors = ours if visitor.path == f"{SCENE_PATH}/" else "'none'"
    policy = (
        "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' data: blob:; form-action 'none'; "
        f"frame-src {ours}; frame-ancestors {ancestors}"
    )
    return _response(HTTPStatus.OK, kind, body, policy)


def _response(status: HTTPStatus, kind: str, body: bytes, policy: str) -> Response:
    """Return a response with the common security headers."""
    headers = Headers(
        {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(body)),
            "Content-Security-Policy": policy,
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
    )
    return Response(status.value, status.phrase, headers, body)
