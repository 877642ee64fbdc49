"""Processes that live and die together. Not for restarting them, and not for what they say to each other."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import FrameType, TracebackType
from typing import Any

Output = Callable[[str, str], None]
"""Takes a process's name and one line that it wrote."""

LIBC = ctypes.CDLL(None)
PR_SET_PDEATHSIG = 1
INTERRUPT = {signal.SIGINT}


class ProcessGroup:
    """Starts processes, hands on what they write, and leaves none behind.

    Each runs in a session of its own, so that Ctrl-C reaches it through `stop` alone and once. SIGINT is blocked
    where it starts: it waits until the process allows it, as a node does once it is ready to end cleanly. If
    this process is killed, the kernel tells them to end.
    """

    def __init__(self, output: Output) -> None:
        self._output = output
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._readers: list[threading.Thread] = []

    def start(self, name: str, command: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
        """Start a process under a name that is not taken; `environment` comes on top of our own."""
        if name in self._processes:
            raise ValueError(f"a process named '{name}' runs already")
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1", **(environment or {})},
            start_new_session=True,
            preexec_fn=_before_exec,
        )
        self._processes[name] = process
        reader = threading.Thread(target=self._read, args=(name, process), daemon=True)
        reader.start()
        self._readers.append(reader)

    def process_id(self, name: str) -> int:
        """Of a process that was started."""
        return self._processes[name].pid

    def ended(self) -> dict[str, int]:
        """Exit codes of the processes that have ended, by name; that of one ended by signal n is -n."""
        codes = {name: process.poll() for name, process in self._processes.items()}
        return {name: code for name, code in codes.items() if code is not None}

    def stop(self, patience: float = 10.0) -> dict[str, int]:
        """End all: SIGINT, after `patience` s SIGTERM, then SIGKILL. Returns the exit codes."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            for process in self._processes.values():
                _send(process, number)
            if _all_end(self._processes.values(), patience):
                break
        for reader in self._readers:
            reader.join(timeout=1.0)
        return self.ended()

    def __enter__(self) -> ProcessGroup:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _read(self, name: str, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        with process.stdout as lines:
            for line in lines:
                self._output(name, line.decode(errors="replace").rstrip("\n"))


class StopSignals:
    """While entered, SIGINT, SIGTERM and SIGHUP are noted instead of raised, however often they come.

    To be entered in the main thread, outside of a `ProcessGroup`, so that a second Ctrl-C does not cut its
    clean-up short. A SIGINT that was held back before comes now. If it was, and in any case once one came, it is
    held back again after the block and ignored, also by threads that began in it: what follows is the end.
    """

    NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def __init__(self) -> None:
        self.received: int | None = None
        self._former: dict[int, Any] = {}
        self._mask: set[int] = set()

    def wait(self, seconds: float) -> bool:
        """Whether one came; returns early if it comes now."""
        until = time.monotonic() + seconds
        while self.received is None and (left := until - time.monotonic()) > 0.0:
            time.sleep(min(left, 0.05))
        return self.received is not None

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = self.received or number

    def __enter__(self) -> StopSignals:
        self._former = {number: signal.signal(number, self._note) for number in self.NUMBERS}
        self._mask = signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPT)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.received or signal.SIGINT in self._mask:
            self._mask |= INTERRUPT
            self._former[signal.SIGINT] = signal.SIG_IGN
        signal.pthread_sigmask(signal.SIG_SETMASK, self._mask)
        for number, handler in self._former.items():
            signal.signal(number, handler)


def _before_exec() -> None:
    """Runs in the child: hold SIGINT back, and have the kernel send SIGTERM when the parent is gone."""
    signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPT)
    LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def _send(process: subprocess.Popen[bytes], number: int) -> None:
    if process.poll() is not None:
        return
    if number == signal.SIGKILL:
        os.killpg(process.pid, number)  # with all that it started
    else:
        process.send_signal(number)


def _all_end(processes: Iterable[subprocess.Popen[bytes]], seconds: float) -> bool:
    until = time.monotonic() + seconds
    for process in processes:
        try:
            process.wait(max(until - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            return False
    return True
