"""Terminals of the tutorials: every kernel runs this file first (PYTHONSTARTUP in conf.py).

A cell that begins with `%%bash` is a terminal's input; `Terminal` is a second one, next to the cells.
"""

from __future__ import annotations

import atexit
import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from IPython.core.magic import register_cell_magic

PATIENCE_S = 120.0
"""Longest wait for a text, on a busy machine."""
COLOURS = ("FORCE_COLOR", "CLICOLOR", "CLICOLOR_FORCE")
"""Variables of the kernel that make programs print colours and progress bars."""
PLAIN = {name: value for name, value in os.environ.items() if name not in COLOURS} | {
    "TERM": "dumb",
    "COLUMNS": "96",
}


@register_cell_magic
def bash(line: str, cell: str) -> None:
    """Run the commands of a cell, and print what they print.

    Args:
        line: Not used.
        cell: The commands; the first that fails ends them.

    Raises:
        RuntimeError: A command failed.
    """
    ended = subprocess.run(
        ["bash", "-e", "-c", cell], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=PLAIN
    )
    print(ended.stdout, end="")
    if ended.returncode != 0:
        raise RuntimeError(f"exit code {ended.returncode}")


class Terminal:
    """Runs a command until `close`, and prints what it prints.

    Args:
        command: The command line.
        ready: Text after which the command is ready.
    """

    def __init__(self, command: str, ready: str) -> None:
        self._log = Path(tempfile.mkdtemp(prefix="terminal-")) / "output"
        with self._log.open("w") as output:
            self._process = subprocess.Popen(
                ["bash", "-c", f"exec {command}"], stdout=output, stderr=subprocess.STDOUT, env=PLAIN
            )
        atexit.register(self._process.kill)
        self._shown = 0
        self._wait_for(ready)
        print(f"$ {command}\n{self._new_text()}", end="")

    def close(self) -> None:
        """Press Ctrl-C, wait for the end, and print the last lines.

        Raises:
            RuntimeError: The command ended with an error.
        """
        self._process.send_signal(signal.SIGINT)
        code = self._process.wait(PATIENCE_S)
        print(f"^C\n{self._new_text()}", end="")
        if code != 0:
            raise RuntimeError(f"exit code {code}")

    def _wait_for(self, text: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while text not in self._log.read_text():
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"no '{text}' in:\n{self._log.read_text()}")
            time.sleep(0.2)

    def _new_text(self) -> str:
        text = self._log.read_text()
        new, self._shown = text[self._shown :], len(text)
        return new
