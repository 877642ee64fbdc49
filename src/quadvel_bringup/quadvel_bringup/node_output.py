"""Output of nodes on the terminal, with the name of the node before each line.

Log lines are shown without their header.
"""

from __future__ import annotations

import itertools
import re
import threading
from collections.abc import Iterable

from rich.console import Console
from rich.text import Text

COLOURS = ("cyan", "green", "magenta", "yellow", "blue")
LOGGED = re.compile(r"\[(DEBUG|INFO|WARN|ERROR|FATAL)\] \[[\d.]+\] \[[^\]]+\]: (.*)")
"""A line of a node's log: its level and its text."""
STYLES = {"WARN": "yellow", "ERROR": "bold red", "FATAL": "bold red"}


class PrefixedOutput:
    """Prints lines of processes with a coloured prefix; call it with name and line.

    Args:
        names: Names of the processes.
        console: Console with `soft_wrap`, so that lines stay whole.
    """

    def __init__(self, names: Iterable[str], console: Console) -> None:

        self._console = console
        self._colours = dict(zip(names, itertools.cycle(COLOURS), strict=False))
        self._width = max(map(len, self._colours), default=0)
        self._lock = threading.Lock()

    def __call__(self, name: str, line: str) -> None:
        """Print a line.

        Args:
            name: Name of the process.
            line: Its line.
        """
        label = Text(f"{name:>{self._width}} | ", style=self._colours[name])
        logged = LOGGED.fullmatch(line)
        text = Text(logged[2], style=STYLES.get(logged[1], "")) if logged else Text.from_ansi(line)
        with self._lock:
            self._console.print(label + text, highlight=False)
