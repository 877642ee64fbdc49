"""What the nodes write, shown to people: line by line behind the name of the node, of its log what it says."""

from __future__ import annotations

import itertools
import re
import threading
from collections.abc import Iterable

from rich.console import Console
from rich.text import Text

COLOURS = ("cyan", "green", "magenta", "yellow", "blue")
LOGGED = re.compile(r"\[(DEBUG|INFO|WARN|ERROR|FATAL)\] \[[\d.]+\] \[[^\]]+\]: (.*)")
"""A line of a node's log: its level and what it says"""
STYLES = {"WARN": "yellow", "ERROR": "bold red", "FATAL": "bold red"}


class PrefixedOutput:
    """Prints each line behind the name of the process that wrote it, a colour each; of a log what it says."""

    def __init__(self, names: Iterable[str], console: Console) -> None:
        """console: one with `soft_wrap`, so that lines stay whole."""
        self._console = console
        self._colours = dict(zip(names, itertools.cycle(COLOURS), strict=False))
        self._width = max(map(len, self._colours), default=0)
        self._lock = threading.Lock()

    def __call__(self, name: str, line: str) -> None:
        label = Text(f"{name:>{self._width}} | ", style=self._colours[name])
        logged = LOGGED.fullmatch(line)
        said = Text(logged[2], style=STYLES.get(logged[1], "")) if logged else Text.from_ansi(line)
        with self._lock:
            self._console.print(label + said, highlight=False)
