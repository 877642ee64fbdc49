"""Several cores at work on what is asked for one after the other; the answers are those that one core would give.

A worker is a copy of this process, so that it knows all that is known here; what it sends back goes without the samples,
which are here already.
"""

from __future__ import annotations

import ctypes
import io
import multiprocessing
import pickle
import signal
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any, Generic, TypeVar

from ..memory import give_gaps_back
from .signals import Samples

R = TypeVar("R")
PR_SET_PDEATHSIG = 1
INTERRUPT = {signal.SIGINT}


class Ahead(Generic[R]):
    """`work` of numbers, on `cores` cores while it is open; with one of them only when a number's turn has come.

    What it gives may hold `samples`, and no others.
    """

    def __init__(self, work: Callable[[int], R], cores: int, samples: Samples) -> None:
        self._work, self._cores, self._samples = work, cores, samples
        self._given: dict[int, Future[bytes]] = {}
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Ahead[R]:
        if self._cores > 1:
            give_gaps_back()
            copies = multiprocessing.get_context("fork")
            task = (self._work, self._samples)
            self._pool = ProcessPoolExecutor(self._cores, copies, initializer=_learn, initargs=task)
            signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPT)  # until the copies end without a word
            self._pool.submit(int)  # which makes them
            signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPT)
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def take(self, number: int, later: Iterable[int]) -> R:
        """What the work gives for this number; those that are likely to be asked for `later` are begun meanwhile."""
        if self._pool is None:
            return self._work(number)
        for one in (number, *later):
            busy = sum(not other.done() for other in self._given.values())
            if one not in self._given and (busy < self._cores or one == number):
                self._given[one] = self._pool.submit(_do, one)
        answer: R = _Unpickler(io.BytesIO(self._given.pop(number).result()), self._samples).load()
        return answer


def side_by_side(work: Callable[[int], R], count: int, cores: int, samples: Samples) -> list[R]:
    """What the work gives for each of the numbers below `count`."""
    with Ahead(work, cores if count > 1 else 1, samples) as ahead:
        return [ahead.take(k, range(k + 1, count)) for k in range(count)]


_task: tuple[Callable[[int], Any], Samples]
"""of a worker"""


def _learn(work: Callable[[int], Any], samples: Samples) -> None:
    global _task
    _task = work, samples
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPT)
    sys.stdout = sys.stderr = None  # their locks may have been copied while held
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # what it waits for would never come


def _do(number: int) -> bytes:
    work, samples = _task
    found = io.BytesIO()
    _Pickler(found, samples).dump(work(number))
    return found.getvalue()


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
