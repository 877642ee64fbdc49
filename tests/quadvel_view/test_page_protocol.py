"""What a page may say: what the schema refuses closes the connection, and the node goes on."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from quadvel_view.page_protocol import (
    MAX_MESSAGE_BYTES,
    Hold,
    ModeRequest,
    PageMessageError,
    Reset,
    Seek,
    parse_message,
)

DIGITS_400 = "1" * 400
SURROGATE = r"\ud800"
NAMES = (
    *("stop", "release", "hold", "let_go", "record", "allow", "reset", "push", "play", "seek", "pace"),
    *("passive", "stand_up", "stance", "walk", "lie_down", "fault", "Stop", ""),
)
FIELDS = ("velocity", "terrain", "to", "time", "pace", "slope", "do")
SAFE = [name for name in NAMES if name != "record"]
"""Starting 10,000 recorders would take a while, and prove nothing about words."""

numbers = st.floats() | st.integers() | st.integers(-(10**400), 10**400)
texts = st.text() | st.sampled_from(["flat", "slope", "rough", "left", "right", "\ud800"])
scalars = st.none() | st.booleans() | numbers | texts
values = st.recursive(
    scalars, lambda inner: st.lists(inner) | st.dictionaries(texts, inner), max_leaves=8
) | st.lists(numbers, min_size=3, max_size=3)
near_words = st.builds(
    lambda name, fields: json.dumps({**fields, "do": name}),
    st.sampled_from(SAFE) | values.filter(lambda value: value != "record"),
    st.dictionaries(st.sampled_from(FIELDS), values, max_size=2),
)
words = near_words | values.map(json.dumps) | st.text(max_size=40) | st.binary(max_size=40)


@pytest.mark.parametrize(
    "text",
    [
        f'{{"do":"hold","velocity":[{DIGITS_400},0,0]}}',
        '{"do":"hold","velocity":[1e999,0,0]}',
        '{"do":"hold","velocity":[NaN,0,0]}',
        '{"do":"hold","velocity":[true,0,0]}',
        '{"do":"hold","velocity":["1",0,0]}',
        '{"do":"hold","velocity":[0,0]}',
        '{"do":"hold"}',
        f'{{"do":"reset","terrain":"{SURROGATE}"}}',
        '{"do":"reset","terrain":"moon"}',
        '{"do":"reset","slope":1}',
        '{"do":"push","to":"up"}',
        '{"do":"seek","time":null}',
        f'{{"do":"seek","time":{DIGITS_400}}}',
        '{"do":"fault"}',
        f'{{"do":"{SURROGATE}"}}',
        '{"do":["stop"]}',
        '{"do":' + "[" * 2000,
        "[1]",
        "{",
        "",
        '"stop"',
        b"\xff\xfe",
        "\ud800",
        '{"do":"stop"}' + " " * MAX_MESSAGE_BYTES,
    ],
)
def test_what_the_schema_does_not_know_is_refused(text: str | bytes) -> None:
    with pytest.raises(PageMessageError) as refused:
        parse_message(text)
    assert str(refused.value).isascii()
    assert len(str(refused.value)) <= 123  # bytes of a WebSocket's reason


def test_what_the_page_says_is_understood() -> None:
    assert parse_message('{"do":"hold","velocity":[1,-0.5,0]}') == Hold((1.0, -0.5, 0.0))
    assert parse_message('{"do":"reset"}') == Reset("")
    assert parse_message('{"do":"seek","time":3}') == Seek(3.0)
    modes = [parse_message(json.dumps({"do": name})) for name in ("passive", "stand_up", "lie_down")]
    assert [word.mode for word in modes if isinstance(word, ModeRequest)] == [
        "passive",
        "stand_up",
        "lie_down",
    ]


@given(words)
def test_any_text_is_a_word_or_refused(text: str | bytes) -> None:
    try:
        word = parse_message(text)
    except PageMessageError:
        return
    if isinstance(word, Hold):
        assert all(abs(value) < float("inf") for value in word.velocity)


class Node:
    """A view node, and pages that talk to it."""

    def __init__(self, log: Path) -> None:
        program = [sys.executable, "-m", "quadvel_bringup", "run", "view", "--ros-args", "-p", "port:=0"]
        with log.open("w") as file:
            self.process = subprocess.Popen(program, stdout=file, stderr=subprocess.STDOUT, cwd=log.parent)
        until = time.monotonic() + 180.0
        while (found := re.search(r"open http://127\.0\.0\.1:(\d+)/", log.read_text())) is None:
            assert self.process.poll() is None, log.read_text()
            assert time.monotonic() < until, log.read_text()
            time.sleep(0.05)
        self._address = f"127.0.0.1:{found[1]}"
        self._page: Any = None

    def open(self) -> Any:
        return connect(f"ws://{self._address}/words", origin=f"http://{self._address}")  # type: ignore[arg-type]

    def hear(self, word: str | bytes) -> None:
        """Say it on a page, which the node closes for what it refuses."""
        self._page = self._page or self.open()
        try:
            self._page.send(word)
        except UnicodeEncodeError:  # no WebSocket can carry it
            return
        try:
            parse_message(word)
        except PageMessageError:
            with pytest.raises(ConnectionClosed, match="not understood"):
                _hear_to_the_end(self._page)
            self._page = None

    def is_alive(self) -> bool:
        """Whether STOP is heeded and shown to whoever looks."""
        with self.open() as page:
            page.send('{"do":"release"}')
            while json.loads(page.recv(timeout=10.0))["stopped"]:
                pass
            page.send('{"do":"stop"}')
            while not json.loads(page.recv(timeout=10.0))["stopped"]:
                pass
            page.send('{"do":"release"}')
        return self.process.poll() is None


def _hear_to_the_end(page: Any) -> None:
    while True:
        page.recv(timeout=10.0)


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Node]:
    node = Node(tmp_path_factory.mktemp("words") / "view.log")
    yield node
    node.process.send_signal(signal.SIGINT)
    assert node.process.wait(30.0) == 0


@pytest.mark.parametrize("count", [200, pytest.param(10_000, marks=pytest.mark.long)])
def test_no_word_ends_the_node(node: Node, count: int) -> None:
    @settings(max_examples=count, suppress_health_check=list(HealthCheck))
    @example(f'{{"do":"hold","velocity":[{DIGITS_400},0,0]}}')
    @example(f'{{"do":"reset","terrain":"{SURROGATE}"}}')
    @given(words)
    def hear(word: str | bytes) -> None:
        node.hear(word)
        assert node.process.poll() is None

    hear()
    assert node.is_alive()
