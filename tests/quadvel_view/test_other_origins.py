"""An attacker's pages and programs, against every port of `up`, `view` and `demo`: no scene, no share, no word accepted.

`quadvel view --foxglove` serves other origins by design and is not among them: it shows topics and takes nothing.
"""

from __future__ import annotations

import shutil
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import product
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
import viser
import yaml

from quadvel_bringup.stack import PARAMETERS
from tests.helpers.sockets import family_of, sockets_of, unix_listeners

QUADVEL = (sys.executable, "-m", "quadvel_bringup")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
VISER = f"viser-v{viser.__version__}"
SOCKETS, FILES = ("/words", "/scene"), ("/", "/scene/")
EVIL = "evil.example"  # the browser is made to take it for this host
PATIENCE = 60.0  # s

Running = tuple[int, set[int]]
"""Number of a process, and its TCP ports and those of its children"""


def commands(folder: Path, recording: Path) -> dict[str, list[str]]:
    """What is attacked; `demo` has no choice of its port."""
    parameters = yaml.safe_load(PARAMETERS.read_text())
    parameters["view"]["ros__parameters"]["port"] = 0
    (folder / "params.yaml").write_text(yaml.safe_dump(parameters))
    return {
        "up": ["up", "--view", "--params", str(folder / "params.yaml")],
        "view": ["view", str(recording), "--port", "0"],
        "demo": ["demo", "--view", "--lockstep", "--no-video", "--out", str(folder / "demo")],
    }


@pytest.fixture(scope="module", params=["up", "view", pytest.param("demo", marks=pytest.mark.long)])
def running(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, walked: Path
) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("attacked")
    if request.param == "demo" and is_taken(8770):
        pytest.skip("somebody else has the demo's port")
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            [*QUADVEL, *commands(folder, walked)[request.param]], stdout=log, stderr=subprocess.STDOUT
        )
    try:
        until = time.monotonic() + PATIENCE
        while not (ports := listening(process.pid)):
            assert process.poll() is None, (folder / "log").read_text()
            assert time.monotonic() < until, (folder / "log").read_text()
            time.sleep(0.1)
        yield process.pid, ports
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30.0)


def is_taken(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def listening(process: int) -> set[int]:
    """TCP ports on which a process and its children take connections."""
    return {one.port for pid in family_of(process) for one in sockets_of(pid) if one.listening}


def handshake(port: int, path: str, host: str | None, origin: str | None) -> int:
    """The status that a WebSocket handshake is answered with."""
    lines = [
        f"GET {path} HTTP/1.1",
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version: 13",
        f"Sec-WebSocket-Protocol: {VISER}",
        *([] if host is None else [f"Host: {host}"]),
        *([] if origin is None else [f"Origin: {origin}"]),
    ]
    with socket.create_connection(("127.0.0.1", port), 10.0) as connection:
        connection.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        answer = connection.makefile("rb").readline()
    return int(answer.split()[1]) if answer else 0


def test_the_page_is_the_only_port_and_viser_has_none(running: Running) -> None:
    process, ports = running
    assert len(ports) == 1
    addresses = {address for pid in family_of(process) for address in unix_listeners(pid)}
    assert "viser" in {Path(address).name for address in addresses}
    for address in addresses:
        folder = Path(address).parent
        assert not address.startswith("@")
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_a_handshake_of_another_origin_is_refused_on_every_port(running: Running) -> None:
    for port in running[1]:
        own = (f"127.0.0.1:{port}", f"localhost:{port}")
        others = [*own, f"{EVIL}:{port}", EVIL, f"192.0.2.1:{port}", None]
        origins = [
            f"http://{EVIL}:{port}",
            f"http://{EVIL}",
            "null",
            None,
            "http://127.0.0.1:1",
            "http://localhost",
        ]
        for path, host, origin in product(SOCKETS + FILES, others, origins):
            assert handshake(port, path, host, origin) in (400, 403), (path, host, origin)
        answers = [
            handshake(port, path, name, f"http://{name}") for path in ("/words", "/scene") for name in own
        ]
        assert answers == [101] * 4


ATTACK = """
async ([ports, sockets, files, protocol]) => {
  const got = [];
  const soon = (work) => Promise.race([work, new Promise((over) => setTimeout(over, 1500))]);
  const connects = (url) => new Promise((over) => {
    const socket = new WebSocket(url, protocol);
    socket.onopen = () => { got.push("socket " + url); socket.send('{"do":"stop"}'); over(); };
    socket.onclose = over;
  });
  const reads = (url) => fetch(url).then(() => got.push("read " + url), () => {});
  const runs = (url) => new Promise((over) => {
    const script = document.createElement("script");
    script.onload = () => { got.push("script " + url); over(); };
    script.onerror = over;
    script.src = url;
    document.head.append(script);
  });
  const shows = (url) => new Promise((over) => {
    const frame = document.createElement("iframe");
    frame.onload = over;
    frame.src = url;
    document.body.append(frame);
  });
  for (const port of ports) for (const host of ["127.0.0.1", "localhost", location.hostname]) {
    const [ws, http] = [`ws://${host}:${port}`, `http://${host}:${port}`];
    const tried = [...sockets.map((path) => connects(ws + path)), runs(http + "/app.js")];
    await soon(Promise.all([...tried, ...files.flatMap((path) => [reads(http + path), shows(http + path)])]));
  }
  return got;
}
"""


class AttackersPage(BaseHTTPRequestHandler):
    """An empty page of the attacker's own."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><body></body>")

    def log_message(self, *_: Any) -> None:
        """In silence."""


@pytest.fixture
def attackers_port() -> Iterator[int]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), AttackersPage)
    thread = Thread(target=server.serve_forever)
    thread.start()
    yield server.server_port
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: apt install chromium")
def test_a_page_of_another_origin_gets_nothing_in_a_browser(running: Running, attackers_port: int) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    ports = sorted(running[1])
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(
            executable_path=CHROMIUM,
            args=["--no-sandbox", "--disable-gpu", f"--host-resolver-rules=MAP {EVIL} 127.0.0.1"],
        )
        for origin in (f"http://{EVIL}:{attackers_port}/", f"http://127.0.0.1:{attackers_port}/"):
            page = browser.new_page()
            page.goto(origin)
            assert page.evaluate(ATTACK, [ports, SOCKETS, FILES, VISER]) == []
            shown = [frame.url for frame in page.frames if frame is not page.main_frame]
            assert len(shown) == 2 * 3 * len(ports)
            assert {url for url in shown if url and not url.startswith("chrome-error:")} == set()
        for (
            port
        ) in ports:  # a name of the attacker's that points here, so that its pages are of the same origin
            page = browser.new_page()
            answer = page.goto(f"http://{EVIL}:{port}/")
            assert answer is not None
            assert answer.status == 403
            assert page.evaluate(ATTACK, [[port], SOCKETS, FILES, VISER]) == []
        browser.close()
