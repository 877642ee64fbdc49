"""The web server of the page: its files, its words both ways, and viser's scene behind the same port and the same token.

viser itself asks nobody who he is, so it listens on this host's loopback interface, and what reaches it from a browser has
passed here: the token where there is one, a Host that is ours where there is none (against names that somebody lets point
at this host), and for WebSockets an Origin that is our own page (against other pages in the operator's browser).

Where the page is called 127.0.0.1 its scene is called localhost, and the other way round: to the browser these are two sites,
each with a process of its own, so that drawing never keeps pad and STOP waiting.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import json
import secrets
import urllib.request
from collections.abc import Callable
from functools import cached_property
from http import HTTPStatus
from http.cookies import SimpleCookie
from importlib.resources import files
from threading import Event, Thread
from typing import Any
from urllib.parse import parse_qs, urlsplit

import attrs
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from .words import Word, WordError, read_word

COOKIE = "quadvel_view"
KINDS = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
PAGE = {"/": "index.html", "/style.css": "style.css", "/app.js": "app.js"}
SCENE, WORDS = "/scene", "/words"
LOOPBACK = "http://127.0.0.1:* http://localhost:*"
# What a browser may load for our pages: nothing from any other host. viser's page is one file that unpacks itself.
POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' data: blob:; "
    f"form-action 'none'; frame-src 'self' {LOOPBACK}; frame-ancestors 'self' {LOOPBACK}"
)
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


@attrs.define
class Guard:
    """Who may come in. token: what every page must show; empty on the loopback interface, where nobody else comes."""

    token: str

    def refusal(self, request: Request) -> str:
        """Why a request is turned away, or ""."""
        host = request.headers.get("Host", "")
        if self.token:
            if not hmac.compare_digest(self._shown(request).encode(), self.token.encode()):
                return "this page needs the token that `quadvel view` printed: open the whole address"
        elif not is_loopback(urlsplit(f"//{host}").hostname or ""):
            return f"this page is for this host alone, and not for '{host}'"
        origin = request.headers.get("Origin")
        if (
            request.headers.get("Upgrade", "").lower() == "websocket"
            and urlsplit(origin or "").netloc != host
        ):
            return f"a page of '{origin}' has no business here"
        return ""

    @staticmethod
    def _shown(request: Request) -> str:
        query = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        cookie = SimpleCookie(request.headers.get("Cookie", "")).get(COOKIE)
        return query or (cookie.value if cookie else "")


def is_loopback(host: str) -> bool:
    """Whether a name or address means this host, by its loopback interface."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class PageServer:
    """Serves from the time it is made until `close`, in a thread of its own.

    on_word: called there with the number of a page and what it said; on_leave: with that of one that left.
    scene: the port of viser on the loopback interface. Raises AddressError where address and port can't be listened on.
    """

    def __init__(
        self,
        host: str,
        port: int,
        scene: int,
        on_word: Callable[[int, Word], None],
        on_leave: Callable[[int], None],
    ) -> None:
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
                max_size=None,
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
        path = urlsplit(request.path).path
        if why := self._guard.refusal(request):
            return _response(HTTPStatus.FORBIDDEN, "text/plain", why.encode() + b"\n")
        if request.headers.get("Upgrade", "").lower() == "websocket":
            known = path in (SCENE, WORDS)
            return (
                None if known else _response(HTTPStatus.NOT_FOUND, "text/plain", b"there is no such socket\n")
            )
        if path == f"{SCENE}/":
            return _response(HTTPStatus.OK, "text/html", self._scene_page)
        if path not in PAGE:
            return _response(HTTPStatus.NOT_FOUND, "text/plain", b"there is no such page\n")
        name = PAGE[path]
        body = files("quadvel_view").joinpath("page", name).read_bytes()
        response = _response(HTTPStatus.OK, KINDS[name.rpartition(".")[2]], body)
        if path == "/" and self._guard.token:
            keep = f"{COOKIE}={self._guard.token}; Path=/; HttpOnly; SameSite=Strict"
            response.headers["Set-Cookie"] = keep
        return response

    @cached_property
    def _scene_page(self) -> bytes:
        with urllib.request.urlopen(f"http://127.0.0.1:{self._scene}/", timeout=10.0) as page:
            text: bytes = page.read()
        return text.replace(b"</head>", PICTURE_ALONE + b"</head>", 1)

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
            async for text in connection:
                self._on_word(page, read_word(text))
        except WordError as error:
            await connection.close(1008, str(error))
        except ConnectionClosed:
            pass
        finally:
            self._pages.discard(connection)
            self._on_leave(page)

    async def _relay(self, browser: ServerConnection) -> None:
        """Hand on what a browser and viser say to each other, until one of them leaves."""
        spoken = [Subprotocol(browser.subprotocol)] if browser.subprotocol else None
        address = f"ws://127.0.0.1:{self._scene}"
        async with connect(address, subprotocols=spoken, compression=None, max_size=None) as scene:
            ways = [asyncio.create_task(_hand_on(*way)) for way in ((browser, scene), (scene, browser))]
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)


async def _hand_on(source: Any, sink: Any) -> None:
    try:
        async for message in source:
            await sink.send(message)
    except ConnectionClosed:
        return


def _response(status: HTTPStatus, kind: str, body: bytes) -> Response:
    headers = Headers(
        {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(body)),
            "Content-Security-Policy": POLICY,
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
    )
    return Response(status.value, status.phrase, headers, body)
