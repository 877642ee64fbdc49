"""Several cores at work on what does not hang on each other; the answers are those that one core would give.

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
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

from .memory import give_gaps_back
from .signals import Samples

R = TypeVar("R")
PR_SET_PDEATHSIG = 1
INTERRUPT = {signal.SIGINT}


def side_by_side(work: Callable[[int], R], count: int, cores: int, samples: Samples) -> list[R]:
    """What the work gives for each of the numbers below `count`; it may hold `samples`, and no others."""
    if cores < 2 or count < 2:
        return [work(k) for k in range(count)]
    give_gaps_back()
    copies = multiprocessing.get_context("fork")
    signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPT)  # until the copies end without a word
    with ProcessPoolExecutor(cores, copies, initializer=_learn, initargs=(work, samples)) as pool:
        given = [pool.submit(_do, k) for k in range(count)]  # which makes the copies
        signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPT)
        return [_Unpickler(io.BytesIO(one.result()), samples).load() for one in given]


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
