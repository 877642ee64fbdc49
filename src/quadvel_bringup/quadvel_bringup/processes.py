"""Groups of child processes that end together, and signals that stop a command.

It does not restart processes.
"""

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
"""Receives name of a process and one line of its output."""

LIBC = ctypes.CDLL(None)
PR_SET_PDEATHSIG = 1
INTERRUPT = {signal.SIGINT}


class ProcessGroup:
    """Starts processes, forwards their output, and leaves none running.

    Each process runs in its own session, so that Ctrl-C reaches it once, through `stop`. It starts
    with SIGINT blocked, and unblocks it when it can end cleanly (a node: after its start). If this
    process is killed, the kernel sends SIGTERM to its children.

    Args:
        output: Receives name and line.
    """

    def __init__(self, output: Output) -> None:
        self._output = output
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._readers: list[threading.Thread] = []

    def start(self, name: str, command: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
        """Start a process.

        Args:
            name: A new name.
            command: The command line.
            environment: Variables in addition to those of this process.

        Raises:
            ValueError: A process of this name exists.
        """
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
        """Return the process id of a started process.

        Args:
            name: Its name.

        Returns:
            The process id.
        """
        return self._processes[name].pid

    def ended(self) -> dict[str, int]:
        """Return the ended processes.

        Returns:
            Exit codes by name; -n for a process ended by signal n.
        """
        codes = {name: process.poll() for name, process in self._processes.items()}
        return {name: code for name, code in codes.items() if code is not None}

    def stop(self, patience: float = 10.0) -> dict[str, int]:
        """Stop all processes: SIGINT, then SIGTERM, then SIGKILL.

        Args:
            patience: Time to wait after each signal, s.

        Returns:
            Exit codes by name.
        """
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
        """Forward the output of a process."""
        assert process.stdout is not None
        with process.stdout as lines:
            for line in lines:
                self._output(name, line.decode(errors="replace").rstrip("\n"))


class StopSignals:
    """Catches SIGINT, SIGTERM and SIGHUP within the block and notes them instead of raising.

    Enter it in the main thread, outside of a `ProcessGroup`, so that a second Ctrl-C does not abort
    its clean-up. A SIGINT that was blocked before arrives inside the block. Where SIGINT was blocked
    before, or a signal arrived, it stays blocked and ignored after the block, also in threads that
    were started inside: the process is about to end.

    Attributes:
        received: Number of the first signal, or None.
    """

    NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def __init__(self) -> None:
        self.received: int | None = None
        self._former: dict[int, Any] = {}
        self._mask: set[int] = set()

    def wait(self, seconds: float) -> bool:
        """Wait for a signal.

        Args:
            seconds: Timeout, s.

        Returns:
            Whether a signal has arrived.
        """
        until = time.monotonic() + seconds
        while self.received is None and (left := until - time.monotonic()) > 0.0:
            time.sleep(min(left, 0.05))
        return self.received is not None

    def _note(self, number: int, frame: FrameType | None) -> None:
        """Note the first signal."""
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
    """In the child: block SIGINT, and let the kernel send SIGTERM when the parent is gone."""
    signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPT)
    LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def _send(process: subprocess.Popen[bytes], number: int) -> None:
    """Send a signal to a running process; SIGKILL to its whole process group."""
    if process.poll() is not None:
        return
    if number == signal.SIGKILL:
        os.killpg(process.pid, number)  # includes its children
    else:
        process.send_signal(number)


def _all_end(processes: Iterable[subprocess.Popen[bytes]], seconds: float) -> bool:
    """Return whether all processes end within a time, s."""
    until = time.monotonic() + seconds
    for process in processes:
        try:
            process.wait(max(until - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            return False
    return True
