"""viser's server on a Unix socket in a private folder, without a TCP port.

viser answers all clients, and a ShareUrlRequest message makes it open a tunnel to a public address.
Browsers cannot connect to a Unix socket, so they get the scene from the page's server (`server`).
That server checks access, and drops what browsers send to viser.

This relies on viser's start-up calling `websockets.asyncio.server.serve` once, so pyproject.toml
pins viser to one minor version. If the call is missing, the scene is refused.
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

TUNNEL_MESSAGES = (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect)
"""Messages that open or close viser's public tunnel; their handlers are removed."""
_starting = Lock()


class SceneServerError(RuntimeError):
    """viser cannot be isolated from the network; the message is one sentence."""


class SceneServer:
    """viser's server on a Unix socket, from construction until `close`.

    Attributes:
        viser: The server that draws the scene.
        path: The Unix socket.

    Raises:
        SceneServerError: The socket cannot be created, or viser listens elsewhere.
    """

    def __init__(self) -> None:
        self._folder = TemporaryDirectory(prefix="quadvel_")
        self.path = Path(self._folder.name) / "viser"
        try:
            self.viser = self._start()
        except BaseException:
            self._folder.cleanup()
            raise
        for message in TUNNEL_MESSAGES:
            self.viser._websock_server.unregister_handler(message)

    def close(self) -> None:
        """Stop viser and remove the socket."""
        _stop(self.viser)
        self._folder.cleanup()

    def _start(self) -> viser.ViserServer:
        """Start viser on a new Unix socket."""
        listener = socket.socket(socket.AF_UNIX)  # viser closes it
        try:
            listener.bind(str(self.path))
        except OSError as error:
            listener.close()
            raise SceneServerError(
                f"{self.path}: cannot create a socket: {error}; TMPDIR selects another folder"
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
                f"viser {viser.__version__} opens a TCP port: install a version that pyproject.toml allows"
            )
        return started


def client_page() -> bytes:
    """Return viser's web client, one self-extracting HTML file.

    Returns:
        The content of the file.
    """
    return files("viser").joinpath("client", "build", "index.html").read_bytes()


@contextmanager
def _serving_on(listener: socket.socket) -> Iterator[list[Any]]:
    """Redirect servers of `websockets` to this socket within the block.

    Yields the list of their handlers.
    """
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
    """Stop viser without its output."""
    with redirect_stdout(StringIO()):
        server.stop()
