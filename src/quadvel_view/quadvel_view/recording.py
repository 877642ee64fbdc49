"""The recordings that the page starts and ends: `quadvel record`, as a process of its own beside the page."""

from __future__ import annotations

import signal
import subprocess
import sys
from datetime import datetime
from pathlib import Path

PATIENCE = 10.0  # s for files to be finished at the end


class Recording:
    """One at a time, into a folder, named after the time."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)
        self._name = ""
        self._running: subprocess.Popen[bytes] | None = None
        self._finishing: list[subprocess.Popen[bytes]] = []

    @property
    def file(self) -> str | None:
        """The file that is being written now."""
        return self._name if self._running is not None and self._running.poll() is None else None

    def toggle(self) -> str:
        """Begin, or have the file finished, for which nobody waits here; what to tell of it."""
        if self._running is not None and self.file:
            self._running.send_signal(signal.SIGINT)
            self._finishing.append(self._running)
            self._running = None
            return f"recorded to {self._name}"
        self._name = str(self._folder / f"{datetime.now():%Y-%m-%d_%H-%M-%S}.mcap")
        self._running = subprocess.Popen(
            [sys.executable, "-m", "quadvel_bringup", "record", "--out", self._name],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        return f"records to {self._name}"

    def close(self) -> None:
        """End what runs, and wait until the files are whole."""
        if self.file:
            self.toggle()
        for process in self._finishing:
            try:
                process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
