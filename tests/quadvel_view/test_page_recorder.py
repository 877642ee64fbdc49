"""The recorder of the page: one process, however often it is asked for."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from quadvel_view import recording
from quadvel_view.recording import PageRecorder

FINISHES_SLOWLY = (
    "import signal, time; signal.signal(signal.SIGINT, lambda *_: None); print(flush=True); time.sleep(600)"
)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """The recorders that were started, each of which ignores that it should finish."""
    processes = []

    class Recorder(subprocess.Popen[bytes]):
        def __init__(self, *_: Any, **__: Any) -> None:
            super().__init__([sys.executable, "-c", FINISHES_SLOWLY], stdout=subprocess.PIPE)
            assert self.stdout is not None
            self.stdout.readline()
            processes.append(self)

    monkeypatch.setattr(recording.subprocess, "Popen", Recorder)
    monkeypatch.setattr(recording, "FINISH_TIMEOUT_S", 0.1)
    return processes


def test_a_recorder_that_cannot_be_started_is_reported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def no_descriptor_left(*_: Any, **__: Any) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(recording.subprocess, "Popen", no_descriptor_left)
    page = PageRecorder(str(tmp_path))
    assert "Too many open files" in page.toggle()
    assert page.file is None
    page.close()


def test_a_page_that_asks_again_and_again_starts_one_recorder(
    started: list[subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    page = PageRecorder(str(tmp_path))
    try:
        for _ in range(50):
            page.toggle()
        assert len(started) == 1
        assert page.file is None
        started[0].kill()
        started[0].wait()
        page.toggle()
        assert len(started) == 2
        assert page.file
    finally:
        page.close()
    assert [process.poll() is not None for process in started] == [True, True]
