"""Independent calls in parallel: over the cores of this machine, or over the workers of a Dask cluster.

What is called and what is made of the answers is the caller's matter.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any, TypeAlias

Call: TypeAlias = tuple[Any, ...]
"""a function that another process can import, and its arguments"""


def in_parallel(calls: Sequence[Call], cluster: str | None = None) -> Iterator[tuple[int, Any]]:
    """Number and answer of each call, as they are done.

    cluster: the address of a Dask scheduler, whose workers see the same files as this machine; None for the
    cores of this one. A KeyboardInterrupt ends it, and the calls under way on this machine.
    """
    with _cores() if cluster is None else _dask(cluster) as submit:
        with _without_windows(), _interrupts_held_back():
            futures = {submit(*call): i for i, call in enumerate(calls)}
        for future in as_completed(futures):
            yield futures[future], future.result()


@contextmanager
def _cores() -> Iterator[Callable[..., Any]]:
    """How to submit a call to a process on one of the cores that this one may use."""
    context = multiprocessing.get_context("spawn")  # forking a process with threads is not safe
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), context, initializer=_end_on_interrupt) as pool:
        try:
            yield pool.submit
        except KeyboardInterrupt:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second one must not cut the clean-up short
            for (
                worker
            ) in multiprocessing.active_children():  # those that started after Ctrl-C did not hear of it
                worker.terminate()
            raise
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _dask(address: str) -> Iterator[Callable[..., Any]]:
    """How to submit a call to the cluster; calls that are left at the end are cancelled."""
    try:
        from distributed import Client
    except ImportError:
        raise ValueError("a cluster needs the package distributed: pip install 'quadvel[cluster]'") from None
    with Client(address) as client:
        executor: Executor = client.get_executor(pure=False)
        yield executor.submit


@contextmanager
def _without_windows() -> Iterator[None]:
    """Processes that are started in the block import MuJoCo without its windows.

    It looks for GLFW in a process of its own otherwise, which takes longer than the rest of the import, and writes
    a traceback where Ctrl-C ends the worker meanwhile.
    """
    before = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        yield
    finally:
        del os.environ["MUJOCO_GL"]
        if before is not None:
            os.environ["MUJOCO_GL"] = before


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """SIGINT waits until the end of the block, and in processes that are started in it until they allow it.

    Ctrl-C reaches the whole group, and a worker that is hit while it still imports would write a traceback.
    """
    resource_tracker.ensure_running()  # it is started with the workers otherwise, and then lets signals through
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    except (BrokenPipeError, BrokenProcessPool):
        if signal.SIGINT not in signal.sigpending():  # otherwise a worker heard of it first, and is gone
            raise
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _end_on_interrupt() -> None:
    """In a worker: SIGINT ends it at once and without a word."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
