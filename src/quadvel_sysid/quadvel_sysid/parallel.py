"""Parallel map over forked worker processes, with the results of a serial run.

A worker is a fork of this process and therefore has its data. Results return by pickle. The
object `shared` is not pickled, because both processes have it.
"""

from __future__ import annotations

import ctypes
import io
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from .memory import trim_heap

Result = TypeVar("Result")
PR_SET_PDEATHSIG = 1
INTERRUPT_SIGNALS = {signal.SIGINT}
_MAX_TASKS = 2048
"""Maximum number of tasks: a pipe of one page (4096 bytes) holds this many 2-byte numbers."""


def parallel_map(work: Callable[[int], Result], count: int, cores: int, shared: object) -> list[Result]:
    """Call a function for the numbers 0 to count - 1, on several cores.

    This process works as well.

    Args:
        work: Function of the task number. Its result may refer to `shared`.
        count: Number of tasks.
        cores: Processes, this one included.
        shared: Large object that results refer to; it is not copied.

    Returns:
        Results in the order of the task numbers.

    Raises:
        ChildProcessError: If a worker process was killed.
        ValueError: If there are too many tasks.
        Exception: Whatever `work` raises.
    """
    if cores < 2 or count < 2:
        return [work(k) for k in range(count)]
    if count > _MAX_TASKS:
        raise ValueError(f"count: found {count}, expected at most {_MAX_TASKS}")
    trim_heap()
    queue = _task_queue(count)
    workers = []
    try:
        # One by one, so that the clean-up finds those already started.
        for _ in range(min(cores, count) - 1):
            workers.append(_Worker(work, queue, shared))  # noqa: PERF401
        found = {k: work(k) for k in _claim_tasks(queue)}
        for worker in workers:
            found |= worker.results()
    finally:
        os.close(queue)
        for worker in workers:
            worker.kill()
    return [found[k] for k in range(count)]


def _task_queue(count: int) -> int:
    """Read end of a pipe with the task numbers; each number is read by one process."""
    reader, writer = os.pipe()
    with os.fdopen(writer, "wb") as file:
        for k in range(count):
            file.write(k.to_bytes(2, "big"))
    return reader


def _claim_tasks(queue: int) -> Iterator[int]:
    """Read task numbers until the pipe is empty."""
    while number := os.read(queue, 2):
        yield int.from_bytes(number, "big")


class _Worker:
    """A fork of this process that works on tasks until none are left."""

    def __init__(self, work: Callable[[int], Any], queue: int, shared: object) -> None:
        self._shared = shared
        reader, writer = os.pipe()
        signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPT_SIGNALS)  # until the worker has its own handler
        self._pid = os.fork()
        if self._pid == 0:
            _run_worker(work, queue, writer, shared)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPT_SIGNALS)
        os.close(writer)
        self._answer = os.fdopen(reader, "rb")

    def results(self) -> dict[int, Any]:
        """Wait for the results.

        Returns:
            Results by task number.

        Raises:
            ChildProcessError: If the worker was killed.
            Exception: The exception that the worker's task raised.
        """
        answer = self._answer.read()
        if not answer:
            raise ChildProcessError("a worker process was killed; check that there is enough memory")
        found = _Unpickler(io.BytesIO(answer), self._shared).load()
        if isinstance(found, Exception):
            raise found
        return dict(found)

    def kill(self) -> None:
        """Kill the worker, if it still runs, and reap it."""
        self._answer.close()
        os.kill(self._pid, signal.SIGKILL)
        os.waitpid(self._pid, 0)


def _run_worker(work: Callable[[int], Any], queue: int, writer: int, shared: object) -> None:
    """Main function of a worker process; does not return."""
    try:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # end with the parent
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPT_SIGNALS)
        sys.stdout = sys.stderr = None  # at the fork another thread may have held their locks
        try:
            answer = _pickled({k: work(k) for k in _claim_tasks(queue)}, shared)
        except Exception as error:
            answer = _pickled(error, shared)
        with os.fdopen(writer, "wb") as file:
            file.write(answer)
    finally:
        os._exit(0)


def _pickled(value: Any, shared: object) -> bytes:
    """Pickle a value, which may hold the shared object."""
    buffer = io.BytesIO()
    _Pickler(buffer, shared).dump(value)
    return buffer.getvalue()


class _Pickler(pickle.Pickler):
    """Pickler that stores a reference instead of the shared object."""

    def __init__(self, file: io.BytesIO, shared: object) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._shared = shared

    def persistent_id(self, value: Any) -> str | None:
        return "shared" if value is self._shared else None


class _Unpickler(pickle.Unpickler):
    """Unpickler that resolves the reference to the shared object."""

    def __init__(self, file: io.BytesIO, shared: object) -> None:
        super().__init__(file)
        self._shared = shared

    def persistent_load(self, name: str) -> object:
        return self._shared
