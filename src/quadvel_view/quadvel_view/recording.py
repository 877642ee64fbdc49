"""Recordings started from the page: `quadvel record` in a separate process.

`quadvel_bringup.record` is what the process runs; `view_node` starts and stops it.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from datetime import datetime
from pathlib import Path

FINISH_TIMEOUT_S = 10.0
"""Time for the recorder to finish its file at the end."""


class PageRecorder:
    """Runs one recorder at a time; files are named after the time of day."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)
        self._name = ""
        self._recorder: subprocess.Popen[bytes] | None = None
        self._is_finishing = False

    @property
    def file(self) -> str | None:
        """Name of the file being recorded, or None."""
        return self._name if self._is_running and not self._is_finishing else None

    def toggle(self) -> str:
        """Start a recording, or request its end without waiting.

        A new recording starts only after the previous recorder has exited, so at most one process
        runs.

        Returns:
            A status sentence.
        """
        if self.file:
            self._finish()
            return f"saved {self._name}"
        if self._is_running:
            return f"still saving {self._name}"
        self._is_finishing = False
        self._name = str(self._folder / f"{datetime.now():%Y-%m-%d_%H-%M-%S}.mcap")
        try:
            self._recorder = self._start()
        except OSError as error:  # the limit of processes or file descriptors is reached
            return f"cannot record: {error}"
        return f"recording to {self._name}"

    def _start(self) -> subprocess.Popen[bytes]:
        """Start the recorder process."""
        return subprocess.Popen(
            [sys.executable, "-m", "quadvel_bringup", "record", "--out", self._name],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def close(self) -> None:
        """Stop the recorder and wait until its file is complete."""
        if self.file:
            self._finish()
        if self._recorder is not None:
            try:
                self._recorder.wait(FINISH_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._recorder.kill()
                self._recorder.wait()

    @property
    def _is_running(self) -> bool:
        """Whether the recorder process runs."""
        return self._recorder is not None and self._recorder.poll() is None

    def _finish(self) -> None:
        """Request the end of the recording."""
        assert self._recorder is not None
        self._recorder.send_signal(signal.SIGINT)
        self._is_finishing = True
