"""viser is behind the guard: no port, no message from outside, no tunnel. Fails where another viser starts in another way."""

from __future__ import annotations

import asyncio
import stat
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import viser
import websockets.asyncio.server as websockets_server
from viser import _messages
from viser._tunnel import ViserTunnel
from websockets.asyncio.client import unix_connect
from websockets.typing import Subprotocol

from quadvel_view.access_control import is_loopback
from quadvel_view.scene_server import SceneServer, SceneServerError, client_page
from quadvel_view.server import AddressError
from quadvel_view.viewer import Viewer
from tests.helpers.robots import ALIENGO

VISER = [Subprotocol(f"viser-v{viser.__version__}")]


@pytest.fixture
def server() -> Iterator[SceneServer]:
    server = SceneServer()
    yield server
    server.close()


def say_to(path: Path, *messages: bytes) -> bytes:
    """The first thing that viser sends to who is on its socket and says this."""

    async def talk() -> bytes:
        async with unix_connect(str(path), "ws://viser/", subprotocols=VISER, max_size=None) as connection:
            for message in messages:
                await connection.send(message)
            first = await asyncio.wait_for(connection.recv(), 20.0)
            await (await connection.ping())
            assert isinstance(first, bytes)
            return first

    return asyncio.run(talk())


def test_viser_draws_to_its_socket_which_this_user_alone_can_open(server: SceneServer) -> None:
    assert say_to(server.path)
    assert stat.S_ISSOCK(server.path.stat().st_mode)
    assert stat.S_IMODE(server.path.parent.stat().st_mode) == 0o700


def test_the_socket_is_gone_once_the_scene_is_closed() -> None:
    server = SceneServer()
    server.close()
    assert not server.path.parent.exists()


def test_no_message_opens_the_tunnel(server: SceneServer, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = threading.Event()
    monkeypatch.setattr(ViserTunnel, "__init__", lambda *_: opened.set())
    ask = _messages.ShareUrlRequest().as_serializable_dict()
    say_to(server.path, _encoded(ask), _encoded(_messages.ShareUrlDisconnect().as_serializable_dict()))
    assert not opened.wait(0.5)


def test_a_viser_that_opens_a_port_of_its_own_draws_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As it would be where it got `serve` in another way than the adapter stands on."""
    by_another_way = websockets_server.serve
    ports = []

    class Other(viser.infra.WebsockServer):
        def _background_worker(self, ready: Any) -> None:
            websockets_server.serve = by_another_way  # type: ignore[misc]
            super()._background_worker(ready)

        def stop(self) -> None:
            ports.append(self._port)
            super().stop()

    monkeypatch.setattr(viser.infra, "WebsockServer", Other)
    with pytest.raises(SceneServerError, match=r"opens a TCP port"):
        SceneServer()
    assert ports
    assert websockets_server.serve is by_another_way


def test_a_folder_for_temporary_files_whose_name_is_too_long_for_a_socket_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    with pytest.raises(AddressError, match=r"x{100}.*TMPDIR"):
        Viewer(ALIENGO, "127.0.0.1", 0, lambda *_: None, lambda _: None)
    assert list(folder.iterdir()) == []


def test_the_page_of_viser_is_one_file() -> None:
    assert b"</head>" in client_page()


def test_what_is_this_host() -> None:
    assert [is_loopback(host) for host in ("127.0.0.1", "::1", "localhost", "127.1", "localhost.", "")] == [
        True,
        True,
        True,
        False,
        False,
        False,
    ]


def _encoded(message: dict[str, Any]) -> bytes:
    import msgspec

    return msgspec.msgpack.encode(message)
