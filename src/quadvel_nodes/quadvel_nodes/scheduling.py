"""Real-time priority, time slice and CPU affinity of nodes. Needs Linux, not ROS."""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import attrs

from quadvel_description.fields import field

MAX_REALTIME_PRIORITY = 99
THREADS_DIR = Path("/proc/self/task")
WATCHDOG_PERIOD_S = 0.05
"""s between two checks of the watchdog: ten periods of the control loop."""
MAX_BUSY_FRACTION = 0.9
"""Share of WATCHDOG_PERIOD_S that a real-time thread may compute; the watchdog demotes busier
threads.
"""
TIME_SLICE_NS = 100_000
"""ns, the shortest time slice of Linux. The scheduler (EEVDF) runs threads with a short slice
before threads with a longer one, such as programs that compute without a pause.
"""
AUTOGROUP_FILE = Path("/proc/self/autogroup")
REALTIME_LIMIT_US = 1_000_000
"""us of computing without a pause after which the kernel ends the process (RLIMIT_RTTIME), in case
the watchdog cannot run.
"""


@attrs.frozen(kw_only=True, slots=False)  # for multiple inheritance
class Scheduling:
    """Scheduling parameters that each node of the control loop adds to its own.

    Attributes:
        realtime_priority: SCHED_FIFO priority of the control thread, 1 to 99; 0 for none.
        cpus: Cores that the node may use, such as "2,3"; empty for any.

    Raises:
        ValueError: A parameter is malformed; raised by the constructor.
    """

    realtime_priority: int = field(
        0,
        "priority of the control thread among real-time ones (SCHED_FIFO), 1 to 99; 0: none",
        at_least=0,
        at_most=MAX_REALTIME_PRIORITY,
        whole=True,
    )
    cpus: str = field("", "cores that the node may use, such as 2,3; empty: any")

    @cpus.validator
    def _are_cores(self, attribute: object, value: str) -> None:
        there = os.sched_getaffinity(0)
        if value and not all(word.strip().isdecimal() and int(word) in there for word in value.split(",")):
            raise ValueError(f"cpus is {value!r}, expected some of {','.join(map(str, sorted(there)))}")

    def apply(self, warn: Callable[[str], object]) -> None:
        """Apply the parameters to this process: cores and time slice to all threads, priority to the caller's.

        The short time slice needs no privilege, and Linux 6.12; older kernels ignore it. Threads
        that start later inherit cores and slice, but not the priority. A real-time thread that
        never pauses would block its core for all other threads, so a watchdog takes the priority
        back from it.

        Args:
            warn: Called with a sentence if the system refuses the priority, and if the watchdog
                acts.
        """
        for thread in (int(one.name) for one in THREADS_DIR.iterdir()):
            if self.cpus:
                os.sched_setaffinity(thread, {int(word) for word in self.cpus.split(",")})
            request_time_slice(thread)
        if not self.realtime_priority:
            return
        try:
            _set_realtime_priority(self.realtime_priority)
        except PermissionError:
            warn(
                "runs without real-time priority: the limit rtprio of this user or container does not allow it"
            )
            return
        resource.setrlimit(resource.RLIMIT_RTTIME, (REALTIME_LIMIT_US, REALTIME_LIMIT_US))
        watched = threading.get_native_id(), time.pthread_getcpuclockid(threading.get_ident())
        above = min(self.realtime_priority + 1, MAX_REALTIME_PRIORITY)
        threading.Thread(
            target=_demote_busy_thread, args=(*watched, above, warn), name="watchdog", daemon=True
        ).start()


def run_after_others(niceness: int) -> None:
    """Lower the priority of this process, so that other processes run first.

    Where Linux groups processes by session (sched_autogroup_enabled), the niceness of a process
    counts only within its session, and the session has a niceness of its own. This function sets
    the niceness of the session, too, if this process leads it, as nodes of `quadvel up` do.

    Args:
        niceness: 1 to 19; a larger value means less CPU time.
    """
    os.nice(niceness)
    if os.getsid(0) == os.getpid():
        with suppress(OSError):  # a kernel without autogroups
            AUTOGROUP_FILE.write_text(str(niceness))


class _SchedulingAttributes(ctypes.Structure):
    """First version of Linux's struct sched_attr, see sched_setattr(2)."""

    _fields_ = (
        ("size", ctypes.c_uint32), ("policy", ctypes.c_uint32), ("flags", ctypes.c_uint64), ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32), ("runtime", ctypes.c_uint64), ("deadline", ctypes.c_uint64), ("period", ctypes.c_uint64),
    )  # fmt: skip


_SYSCALL_NUMBERS = {"x86_64": (314, 315), "aarch64": (274, 275)}
"""Numbers of the system calls sched_setattr and sched_getattr, which the C library does not wrap.
"""


def request_time_slice(thread: int) -> None:
    """Set the time slice of a thread to TIME_SLICE_NS, unless the thread has real-time priority.

    Args:
        thread: Native id of the thread.
    """
    write, _ = _SYSCALL_NUMBERS.get(platform.machine(), (0, 0))
    attributes = _read_attributes(thread)
    if attributes is not None and attributes.policy in (os.SCHED_OTHER, os.SCHED_BATCH):
        attributes.runtime = TIME_SLICE_NS
        ctypes.CDLL(None).syscall(write, thread, ctypes.byref(attributes), 0)


def time_slice(thread: int) -> int | None:
    """Return the time slice of a thread.

    Args:
        thread: Native id of the thread.

    Returns:
        The slice, ns; 0 before Linux 6.12, None where the system call fails.
    """
    attributes = _read_attributes(thread)
    return None if attributes is None else int(attributes.runtime)


def _read_attributes(thread: int) -> _SchedulingAttributes | None:
    """Return the scheduling attributes of a thread, or None where the system call fails."""
    _, read = _SYSCALL_NUMBERS.get(platform.machine(), (0, 0))
    found = _SchedulingAttributes()
    size = ctypes.sizeof(found)
    failed = not read or ctypes.CDLL(None).syscall(read, thread, ctypes.byref(found), size, 0)
    found.size = size
    return None if failed else found


def _set_realtime_priority(priority: int) -> None:
    """Give the calling thread a SCHED_FIFO priority, which its children do not inherit."""
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


def _demote_busy_thread(thread: int, cpu_clock: int, priority: int, warn: Callable[[str], object]) -> None:
    """Take the real-time priority from a thread once it computes without a pause.

    Runs in a thread of its own with a higher priority than the watched one.

    Args:
        thread: Native id of the watched thread.
        cpu_clock: Id of the CPU clock of that thread.
        priority: Real-time priority of the watchdog.
        warn: Called with a sentence when the priority is taken.
    """
    _set_realtime_priority(priority)
    try:
        while True:
            began, used = time.monotonic(), time.clock_gettime(cpu_clock)
            time.sleep(WATCHDOG_PERIOD_S)
            if time.clock_gettime(cpu_clock) - used >= MAX_BUSY_FRACTION * (time.monotonic() - began):
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
                warn(
                    f"computed for {WATCHDOG_PERIOD_S:g} s without a pause: its real-time priority was taken back"
                )
                return
    except OSError:  # the thread has ended
        return
