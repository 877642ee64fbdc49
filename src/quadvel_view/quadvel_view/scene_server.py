"""viser's server without a port of its own: it listens on a Unix socket in a folder that only this user can open.

viser answers whoever connects, and at a message called ShareUrlRequest it opens a tunnel to a public address. No browser
reaches a Unix socket: what a browser gets of the scene has passed the page's guard, and nothing that it says comes here.

This rests on how viser starts, so pyproject.toml holds viser at one minor version: it calls `websockets.asyncio.server.serve`
once. Where it does not, there is no scene.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from importlib.resources import files
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import viser
from viser import _messages
from websockets.asyncio import server as websockets_server

TUNNEL = (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect)
_starting = Lock()


class SceneServerError(RuntimeError):
    """viser cannot be kept from the network; one sentence."""


class SceneServer:
    """Runs from the time it is made until `close`.

    Attributes:
        viser: What draws the scene.
        path: The Unix socket that viser listens on.

    Raises:
        SceneServerError: Where the socket cannot be made, or viser listens elsewhere.
    """

    def __init__(self) -> None:
        self._folder = TemporaryDirectory(prefix="quadvel_")
        self.path = Path(self._folder.name) / "viser"
        try:
            self.viser = self._start()
        except BaseException:
            self._folder.cleanup()
            raise
        for message in TUNNEL:
            self.viser._websock_server.unregister_handler(message)

    def close(self) -> None:
        """End viser and its socket."""
        _stop(self.viser)
        self._folder.cleanup()

    def _start(self) -> viser.ViserServer:
        listener = socket.socket(socket.AF_UNIX)  # viser closes it
        try:
            listener.bind(str(self.path))
        except OSError as error:
            listener.close()
            raise SceneServerError(
                f"{self.path}: no socket can be made there: {error}; TMPDIR names the folder"
            ) from None
        with (
            _starting,
            _serving_on(listener) as calls,
            redirect_stdout(StringIO()),
        ):  # viser prints its addresses
            started = viser.ViserServer("127.0.0.1", 0, verbose=False)
        if not calls:
            listener.close()
            _stop(started)
            raise SceneServerError(
                f"viser {viser.__version__} opens a port of its own: install a version that pyproject.toml names"
            )
        return started


def page() -> bytes:
    """viser's page: one file that unpacks itself."""
    return files("viser").joinpath("client", "build", "index.html").read_bytes()


@contextmanager
def _serving_on(listener: socket.socket) -> Iterator[list[Any]]:
    """Until the end of the block, servers that websockets makes listen on this socket. Gives the list of their handlers."""
    serve, handlers = websockets_server.serve, list[Any]()

    def serve_on_listener(handler: Any, *address: Any, **options: Any) -> Any:
        handlers.append(handler)
        return serve(handler, unix=True, sock=listener, **options)

    websockets_server.serve = serve_on_listener  # type: ignore[assignment, misc]
    try:
        yield handlers
    finally:
        websockets_server.serve = serve  # type: ignore[misc]


def _stop(server: viser.ViserServer) -> None:
    with redirect_stdout(StringIO()):
        server.stop()
