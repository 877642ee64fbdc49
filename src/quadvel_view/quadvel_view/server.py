"""The web server of the page: its files, its words both ways, and viser's scene behind the same port and the same guard.

The scene goes one way: what viser draws is passed on to the browser, and what the browser says to viser ends here.

Where the page is called 127.0.0.1 its scene is called localhost, and the other way round: to the browser these are two sites,
each with a process of its own, so that drawing never keeps pad and STOP waiting. Where there is a token both have one name, as
the cookie with the token stays with the name that it was set for.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
from collections.abc import Callable
from functools import cached_property
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from threading import Event, Thread
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection, unix_connect
from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.frames import CloseCode
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from . import scene_server
from .guard import Guard, RequestError, Visitor, is_loopback
from .words import LARGEST_WORD, Word, WordError, read_word

COOKIE = "quadvel_view"
"""start of the name of the cookie with the token; the port follows, as cookies are sent to all ports of a host"""
KINDS = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
PAGE = {"/": "index.html", "/style.css": "style.css", "/app.js": "app.js"}
SCENE, WORDS = "/scene", "/words"
SCENE_FRAME, WITH_TOKEN = b'<iframe id="scene"', b" data-with-token"
"""how the page is told that there is a token, which it cannot see itself"""
MOST_FRAGMENTS = 16
"""of one message: browsers send one of LARGEST_WORD whole, and an empty fragment costs memory, too"""
MOST_SOCKETS = 32
"""at a time, of which a page has two: each takes time from the words of the others, STOP among them"""
# viser's own panel and notes have no place beside ours: of its page there is the picture alone. It looks for its server while
# it has the focus, which stays with our page.
PICTURE_ALONE = (
    b"<style>body *{visibility:hidden!important}canvas{visibility:visible!important}</style>"
    b"<script>document.hasFocus = () => true;"
    b"new MutationObserver((_, self) => { if (document.querySelector('canvas')) { self.disconnect();"
    b"parent.postMessage('drawn', '*'); } }).observe(document, { childList: true, subtree: true });</script>"
)


class AddressError(ValueError):
    """The page cannot be served there; one sentence."""


def _is_own_fault(record: logging.LogRecord) -> bool:
    """Whether a line of the log is about more than a handshake that makes no sense or is left, which anybody may do."""
    return not (record.exc_info and isinstance(record.exc_info[1], InvalidHandshake | ConnectionClosed))


LOG = logging.getLogger("quadvel_view.page")
LOG.addFilter(_is_own_fault)


class PageServer:
    """Serves from the time it is made until `close`, in a thread of its own.

    on_word: called there with the number of a page and what it said; on_leave: with that of one that left.
    scene: the Unix socket of viser. Raises AddressError where address and port can't be listened on.
    """

    def __init__(
        self,
        host: str,
        port: int,
        scene: Path,
        on_word: Callable[[int, Word], None],
        on_leave: Callable[[int], None],
    ) -> None:
        if not host:
            raise AddressError(
                "host is '', expected an address such as 127.0.0.1, or 0.0.0.0 for all interfaces"
            )
        self._host, self._port, self._scene = host, port, scene
        self._on_word, self._on_leave = on_word, on_leave
        self._guard = Guard("" if is_loopback(host) else secrets.token_urlsafe(18))
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
        """What to open, with the token where one is needed."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        query = f"?token={self._guard.token}" if self._guard.token else ""
        return f"http://{host}:{self._port}/{query}"

    @property
    def is_watched(self) -> bool:
        """Whether a page is open."""
        return bool(self._pages)

    def tell(self, words: dict[str, Any]) -> None:
        """Say something to every page; from any thread."""
        if self._pages:
            text = json.dumps(words, separators=(",", ":"), allow_nan=False)
            self._loop.call_soon_threadsafe(lambda: broadcast(self._pages, text))

    def close(self) -> None:
        """End all connections, and the thread."""
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()
        self._loop.close()

    async def _serve(self) -> None:
        try:
            async with serve(
                self._serve_socket,
                self._host,
                self._port,
                process_request=self._answer,
                select_subprotocol=lambda connection, offered: offered[0] if offered else None,
                compression=None,
                max_size=LARGEST_WORD,
                logger=LOG,
            ) as server:
                self._port = next(iter(server.sockets)).getsockname()[1]
                self._ready.set()
                await self._stop.wait()
        except (OSError, OverflowError, UnicodeError) as error:  # the latter two: no port, no host name
            reason = getattr(error, "strerror", None) or error
            self._error = f"{self._host}:{self._port}: the page can't be served there: {reason}"
        finally:
            self._ready.set()

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The answer to a request for a file, or None for a WebSocket that may come in."""
        try:
            visitor = self._guard.admit(request)
        except RequestError as error:
            return _sentence(error.status, str(error))
        if visitor.wants_socket:
            return self._refusal_of_socket(connection, visitor)
        if visitor.path == f"{SCENE}/":
            return _page("text/html", self._scene_page, visitor)
        if visitor.path not in PAGE:
            return _sentence(HTTPStatus.NOT_FOUND, "there is no such page")
        return self._file(PAGE[visitor.path], visitor)

    @staticmethod
    def _refusal_of_socket(connection: ServerConnection, visitor: Visitor) -> Response | None:
        if visitor.path not in (SCENE, WORDS):
            return _sentence(HTTPStatus.NOT_FOUND, "there is no such socket")
        if len(connection.server.connections) >= MOST_SOCKETS:
            reason = f"{MOST_SOCKETS} connections are open: close another page of this robot"
            return _sentence(HTTPStatus.SERVICE_UNAVAILABLE, reason)
        return None

    def _file(self, name: str, visitor: Visitor) -> Response:
        body = files("quadvel_view").joinpath("page", name).read_bytes()
        with_token = visitor.path == "/" and self._guard.token
        if with_token:
            body = body.replace(SCENE_FRAME, SCENE_FRAME + WITH_TOKEN)
        response = _page(KINDS[name.rpartition(".")[2]], body, visitor)
        if with_token:
            keep = f"{COOKIE}_{self._port}={self._guard.token}; Path=/; HttpOnly; SameSite=Strict"
            response.headers["Set-Cookie"] = keep
        return response

    @cached_property
    def _scene_page(self) -> bytes:
        return scene_server.page().replace(b"</head>", PICTURE_ALONE + b"</head>", 1)

    async def _serve_socket(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        if urlsplit(connection.request.path).path == SCENE:
            await self._relay(connection)
        else:
            await self._listen(connection)

    async def _listen(self, connection: ServerConnection) -> None:
        """Hear one page until it leaves."""
        self._count += 1
        page = self._count
        self._pages.add(connection)
        try:
            while (text := await _message(connection)) is not None:
                self._on_word(page, read_word(text))
        except WordError as error:
            await connection.close(1008, str(error))
        except ConnectionClosed:
            pass
        finally:
            self._pages.discard(connection)
            self._on_leave(page)

    async def _relay(self, browser: ServerConnection) -> None:
        """Show a browser what viser draws, until one of them leaves. What the browser says is not passed on."""
        spoken = [Subprotocol(browser.subprotocol)] if browser.subprotocol else None
        path = str(self._scene)
        async with unix_connect(
            path, "ws://viser/", subprotocols=spoken, compression=None, max_size=None
        ) as scene:
            ways = [asyncio.create_task(way) for way in (_show(scene, browser), _ignore(browser))]
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)


async def _show(scene: ClientConnection, browser: ServerConnection) -> None:
    try:
        async for message in scene:
            await browser.send(message)
    except ConnectionClosed:
        return


async def _ignore(browser: ServerConnection) -> None:
    """Read a browser's messages, fragment by fragment, so that pings are answered and its leaving is seen."""
    try:
        while True:
            async for _ in browser.recv_streaming(decode=False):
                pass
    except ConnectionClosed:
        return


async def _message(connection: ServerConnection) -> bytes | None:
    """The next message of a page, or None where it has too many fragments. Raises ConnectionClosed when the page left."""
    fragments = []
    async for fragment in connection.recv_streaming(decode=False):
        fragments.append(fragment)
        if len(fragments) > MOST_FRAGMENTS:
            await connection.close(CloseCode.MESSAGE_TOO_BIG, f"more than {MOST_FRAGMENTS} fragments")
            return None
    return b"".join(fragments)


def _sentence(status: HTTPStatus, sentence: str) -> Response:
    return _response(
        status, "text/plain", f"{sentence}\n".encode(), "default-src 'none'; frame-ancestors 'none'"
    )


def _page(kind: str, body: bytes, visitor: Visitor) -> Response:
    """A file of the page or of the scene, and what the browser may do with it.

    It loads nothing from any other host. Only our page may show the scene in a frame, and no page may show ours in one, where a
    press of a button would be taken for the operator's. viser's page is one file that unpacks itself, hence 'unsafe-eval'.
    """
    ours = "'self'"
    if is_loopback(visitor.name.strip("[]")):  # the page and its scene under the two names of this host
        ours += "".join(f" http://{name}{visitor.port}" for name in ("127.0.0.1", "localhost"))
    ancestors = ours if visitor.path == f"{SCENE}/" else "'none'"
    policy = (
        "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' data: blob:; form-action 'none'; "
        f"frame-src {ours}; frame-ancestors {ancestors}"
    )
    return _response(HTTPStatus.OK, kind, body, policy)


def _response(status: HTTPStatus, kind: str, body: bytes, policy: str) -> Response:
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
