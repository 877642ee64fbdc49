"""Runs independent calls in parallel, on the cores of this machine or on a Dask cluster.

It knows nothing of simulations: `grid`, `faults.campaign` and `paper.study` make the calls.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any, TypeAlias

Call: TypeAlias = tuple[Any, ...]
"""Function that another process can import, and its arguments."""


def run_in_parallel(calls: Sequence[Call], cluster: str | None = None) -> Iterator[tuple[int, Any]]:
    """Run calls in parallel and yield each answer when it is ready.

    A KeyboardInterrupt ends the iteration and the calls in progress on this machine.

    Args:
        calls: Each a function that another process can import, and its arguments.
        cluster: Address of a Dask scheduler whose workers see the same files; None for the cores
            of this machine.

    Yields:
        Index of a call and its answer.
    """
    with _process_pool() if cluster is None else _dask_cluster(cluster) as submit:
        with _without_display(), _interrupts_blocked():
            futures = {submit(*call): i for i, call in enumerate(calls)}
        for future in as_completed(futures):
            yield futures[future], future.result()


@contextmanager
def _process_pool() -> Iterator[Callable[..., Any]]:
    """Provide a function that submits a call to a process on one of the available cores."""
    context = multiprocessing.get_context("spawn")  # forking a process with threads is not safe
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), context, initializer=_start_worker) as pool:
        try:
            yield pool.submit
        except KeyboardInterrupt:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C must not interrupt the clean-up
            for (
                worker
            ) in multiprocessing.active_children():  # those that started after Ctrl-C did not receive it
                worker.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)  # waits: else Python itself may use a closed pipe at its exit


@contextmanager
def _dask_cluster(address: str) -> Iterator[Callable[..., Any]]:
    """Provide a function that submits a call to the cluster; cancel pending calls at the end."""
    try:
        from distributed import Client
    except ImportError:
        raise ValueError(
            "a cluster needs the package distributed: pip install 'quadvel-core[cluster]'"
        ) from None
    with Client(address) as client:
        executor: Executor = client.get_executor(pure=False)
        yield executor.submit


@contextmanager
def _without_display() -> Iterator[None]:
    """Set MUJOCO_GL to "disable" for processes that start in the block.

    Otherwise MuJoCo probes GLFW in a child process. The probe takes longer than the rest of the
    import, and prints a traceback if Ctrl-C ends the worker meanwhile.
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
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT until the end of the block, also in processes that start in it.

    Ctrl-C reaches the whole process group. A worker that receives it during its imports would
    print a traceback. Workers unblock SIGINT in `_start_worker`.
    """
    resource_tracker.ensure_running()  # otherwise it starts with the workers and unblocks signals
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    except (BrokenPipeError, BrokenProcessPool):
        if signal.SIGINT not in signal.sigpending():  # pending: a worker received it first and ended
            raise
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _start_worker() -> None:
    """Let SIGINT, and the death of the parent process, end this worker immediately and silently."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _end_with_parent() -> None:
    """Wait for the end of the parent process; a killed parent cannot end its workers itself."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
