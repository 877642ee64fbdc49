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
        self._recorder: subprocess.Popen[bytes] | None = None
        self._is_finishing = False

    @property
    def file(self) -> str | None:
        """The file that is being written now."""
        return self._name if self._is_running and not self._is_finishing else None

    def toggle(self) -> str:
        """Begin, or have the file finished, for which nobody waits here; what to tell of it.

        The next file begins after the last one is finished, so that there is one process, however often a page asks.
        """
        if self.file:
            self._finish()
            return f"recorded to {self._name}"
        if self._is_running:
            return f"{self._name} is still being finished"
        self._is_finishing = False
        self._name = str(self._folder / f"{datetime.now():%Y-%m-%d_%H-%M-%S}.mcap")
        try:
            self._recorder = self._start()
        except OSError as error:  # no process or no file descriptor is left
            return f"no recording: {error}"
        return f"records to {self._name}"

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "quadvel_bringup", "record", "--out", self._name],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def close(self) -> None:
        """End what runs, and wait until its file is whole."""
        if self.file:
            self._finish()
        if self._recorder is not None:
            try:
                self._recorder.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                self._recorder.kill()
                self._recorder.wait()

    @property
    def _is_running(self) -> bool:
        return self._recorder is not None and self._recorder.poll() is None

    def _finish(self) -> None:
        assert self._recorder is not None
        self._recorder.send_signal(signal.SIGINT)
        self._is_finishing = True
