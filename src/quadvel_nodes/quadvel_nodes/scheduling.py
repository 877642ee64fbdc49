"""When a node runs: those of the control loop before others, and on which cores; the page after them. Needs Linux, not ROS."""

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

HIGHEST = 99
THREADS = Path("/proc/self/task")
LOOK = 0.05
"""s, ten periods of the control loop: a thread that computes this long without a pause is not waiting for a robot"""
BUSY = 0.9
"""share of LOOK that a thread computed, from which on it counts as one that does not pause"""
SLICE = 100_000
"""ns, the shortest that there is: a thread that asks for so little of a core at once is let in before those that ask for
more, such as programs that compute without a pause beside it."""
AUTOGROUP = Path("/proc/self/autogroup")
LAST_RESORT = 1_000_000
"""us of computing without a pause after which the kernel ends the process: the watchdog could not run"""


@attrs.frozen(kw_only=True, slots=False)  # to stand beside another base
class Scheduling:
    """Parameters that a node of the control loop adds to its own, and what puts them into force.

    Raises ValueError where one of them is malformed.
    """

    realtime_priority: int = attrs.field(
        default=0,
        metadata={
            "description": "priority of the control thread among real-time ones (SCHED_FIFO), 1 to 99; 0: none"
        },
    )
    cpus: str = attrs.field(
        default="", metadata={"description": "cores that the node may use, such as 2,3; empty: any"}
    )

    @realtime_priority.validator
    def _is_priority(self, attribute: object, value: int) -> None:
        if not 0 <= value <= HIGHEST:
            raise ValueError(f"realtime_priority is {value}, expected 0 to {HIGHEST}")

    @cpus.validator
    def _are_cores(self, attribute: object, value: str) -> None:
        there = os.sched_getaffinity(0)
        if value and not all(word.strip().isdecimal() and int(word) in there for word in value.split(",")):
            raise ValueError(f"cpus is {value!r}, expected some of {','.join(map(str, sorted(there)))}")

    def apply(self, say: Callable[[str], object]) -> None:
        """The cores and a short time slice to all threads of this process, the priority to the thread that calls.

        The slice takes no privilege, and Linux 6.12; before, nothing changes. Threads that are started later inherit it, but
        not the priority. A watchdog takes it back from a thread that does not pause,
        since a real-time thread that spins takes its core from everybody else. `say` is told of that, and of a system
        that refuses the priority.
        """
        for thread in (int(one.name) for one in THREADS.iterdir()):
            if self.cpus:
                os.sched_setaffinity(thread, {int(word) for word in self.cpus.split(",")})
            ask_for_slice(thread)
        if not self.realtime_priority:
            return
        try:
            _become_realtime(self.realtime_priority)
        except PermissionError:
            say(
                "runs without real-time priority: the limit rtprio of this user or container does not allow it"
            )
            return
        resource.setrlimit(resource.RLIMIT_RTTIME, (LAST_RESORT, LAST_RESORT))
        watched = threading.get_native_id(), time.pthread_getcpuclockid(threading.get_ident())
        above = min(self.realtime_priority + 1, HIGHEST)
        threading.Thread(target=_watch, args=(*watched, above, say), name="watchdog", daemon=True).start()


def run_after_others(niceness: int) -> None:
    """Let other processes run first.

    Where Linux groups processes by session (sched_autogroup_enabled), a process's niceness counts within its session alone;
    the session has a niceness of its own, which is set where this process leads it, as the nodes of `quadvel up` do. A shell's
    session is left as it is.

    Args:
        niceness: 1 to 19, the weaker the larger.
    """
    os.nice(niceness)
    if os.getsid(0) == os.getpid():
        with suppress(OSError):  # a kernel that forms no such groups
            AUTOGROUP.write_text(str(niceness))


class _Attributes(ctypes.Structure):
    """Linux' struct sched_attr, of its first version."""

    _fields_ = (
        ("size", ctypes.c_uint32), ("policy", ctypes.c_uint32), ("flags", ctypes.c_uint64), ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32), ("runtime", ctypes.c_uint64), ("deadline", ctypes.c_uint64), ("period", ctypes.c_uint64),
    )  # fmt: skip


_CALLS = {"x86_64": (314, 315), "aarch64": (274, 275)}
"""The numbers of the system calls sched_setattr and sched_getattr, for which the C library has no name yet"""


def ask_for_slice(thread: int) -> None:
    """Ask that `thread` gets a core for no more than SLICE at once, and the sooner for it, where it has no real-time priority."""
    write, _ = _CALLS.get(platform.machine(), (0, 0))
    attributes = _attributes(thread)
    if attributes is not None and attributes.policy in (os.SCHED_OTHER, os.SCHED_BATCH):
        attributes.runtime = SLICE
        ctypes.CDLL(None).syscall(write, thread, ctypes.byref(attributes), 0)


def slice_of(thread: int) -> int | None:
    """ns that `thread` gets a core for at once; None where this system does not say, 0 before Linux 6.12."""
    attributes = _attributes(thread)
    return None if attributes is None else int(attributes.runtime)


def _attributes(thread: int) -> _Attributes | None:
    _, read = _CALLS.get(platform.machine(), (0, 0))
    found = _Attributes()
    size = ctypes.sizeof(found)
    failed = not read or ctypes.CDLL(None).syscall(read, thread, ctypes.byref(found), size, 0)
    found.size = size
    return None if failed else found


def _become_realtime(priority: int) -> None:
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


def _watch(thread: int, cpu_clock: int, priority: int, say: Callable[[str], object]) -> None:
    """Take the real-time priority of a thread back once it computes without a pause. Runs before that thread."""
    _become_realtime(priority)
    try:
        while True:
            began, used = time.monotonic(), time.clock_gettime(cpu_clock)
            time.sleep(LOOK)
            if time.clock_gettime(cpu_clock) - used >= BUSY * (time.monotonic() - began):
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
                say(f"computed for {LOOK:g} s without a pause: its real-time priority was taken back")
                return
    except OSError:  # the thread has ended
        return
