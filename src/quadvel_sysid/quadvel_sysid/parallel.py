"""Several cores at work on what does not hang on each other; the answers are those that one core would give.

A helper is a copy of this process, so that it knows all that is known here; what it sends back goes without the samples,
which are here already.
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
from .signals import Samples

R = TypeVar("R")
PR_SET_PDEATHSIG = 1
INTERRUPT = {signal.SIGINT}
_MOST = 2048
"""Pieces of work: as many numbers of two bytes as a pipe of one page holds"""


def side_by_side(work: Callable[[int], R], count: int, cores: int, samples: Samples) -> list[R]:
    """What the work gives for each of the numbers below `count`; it may hold `samples`, and no others.

    This process works as well. Raises what the work raises, and ChildProcessError where a helper was killed.
    """
    if cores < 2 or count < 2:
        return [work(k) for k in range(count)]
    if count > _MOST:
        raise ValueError(f"{count} pieces of work, expected {_MOST} at most")
    trim_heap()
    todo = _numbers(count)
    helpers = []
    try:
        for _ in range(min(cores, count) - 1):
            helpers.append(_Helper(work, todo, samples))
        found = {k: work(k) for k in _taken(todo)}
        for helper in helpers:
            found |= helper.found()
    finally:
        os.close(todo)
        for helper in helpers:
            helper.end()
    return [found[k] for k in range(count)]


def _numbers(count: int) -> int:
    """The end to read from of a pipe with the numbers below `count`, each of which one process takes."""
    reader, writer = os.pipe()
    with os.fdopen(writer, "wb") as file:
        for k in range(count):
            file.write(k.to_bytes(2, "big"))
    return reader


def _taken(todo: int) -> Iterator[int]:
    while number := os.read(todo, 2):
        yield int.from_bytes(number, "big")


class _Helper:
    """A copy of this process that takes numbers until none are left."""

    def __init__(self, work: Callable[[int], Any], todo: int, samples: Samples) -> None:
        self._samples = samples
        reader, writer = os.pipe()
        signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPT)  # until the copy ends without a word
        self._pid = os.fork()
        if self._pid == 0:
            _serve(work, todo, writer, samples)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPT)
        os.close(writer)
        self._answer = os.fdopen(reader, "rb")

    def found(self) -> dict[int, Any]:
        """Its answers by number. Waits for them."""
        answer = self._answer.read()
        if not answer:
            raise ChildProcessError("a process that helps to identify was killed; is memory short?")
        found = _Unpickler(io.BytesIO(answer), self._samples).load()
        if isinstance(found, Exception):
            raise found
        return dict(found)

    def end(self) -> None:
        """Kill it, should it still be at work."""
        self._answer.close()
        os.kill(self._pid, signal.SIGKILL)
        os.waitpid(self._pid, 0)


def _serve(work: Callable[[int], Any], todo: int, writer: int, samples: Samples) -> None:
    """What a helper does; it never returns."""
    try:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # who would hear it has ended
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPT)
        sys.stdout = sys.stderr = None  # their locks may have been copied while held
        try:
            found: Any = {k: work(k) for k in _taken(todo)}
        except Exception as error:
            found = error
        answer = io.BytesIO()
        _Pickler(answer, samples).dump(found)
        with os.fdopen(writer, "wb") as file:
            file.write(answer.getvalue())
    finally:
        os._exit(0)


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, samples: Samples) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._samples = samples

    def persistent_id(self, value: Any) -> str | None:
        return "samples" if value is self._samples else None


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, samples: Samples) -> None:
        super().__init__(file)
        self._samples = samples

    def persistent_load(self, name: str) -> Samples:
        return self._samples
