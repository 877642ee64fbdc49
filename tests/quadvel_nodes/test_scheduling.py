"""Real-time priority and cores of a node's threads, seen from outside."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from quadvel_nodes.scheduling import AUTOGROUP_FILE, TIME_SLICE_NS, Scheduling, time_slice

APPLY = """
import os, threading, time
from quadvel_nodes.scheduling import Scheduling

def scheduled(thread):
    policy = os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK
    return policy, os.sched_getparam(thread).sched_priority, os.sched_getaffinity(thread)

go = threading.Event()
others = [threading.Thread(target=go.wait)]
others[0].start()
Scheduling(realtime_priority={priority}, cpus="{cpus}").apply(print)
others.append(threading.Thread(target=go.wait))
others[1].start()
for thread in (0, *(other.native_id for other in others)):
    print(*scheduled(thread))
until = time.monotonic() + {spin}
while time.monotonic() < until:
    time.sleep({pause})
print(*scheduled(0))
go.set()
"""


def lines(priority: int, cpus: str = "", spin: float = 0.0, pause: float = 0.0) -> list[str]:
    """Output of a separate process after `apply`: its main thread, an older and a newer thread, and the end."""
    code = APPLY.format(priority=priority, cpus=cpus, spin=spin, pause=pause)
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return result.stdout.splitlines()


def realtime_lines(priority: int, **options: float) -> list[str]:
    """The same where the system allows real-time priority."""
    found = lines(priority, **options)  # type: ignore[arg-type]
    if found[0].startswith("runs without real-time priority"):
        pytest.skip(found[0])
    return found


def test_the_thread_that_asks_gets_the_priority_and_no_other() -> None:
    control, older, newer, _ = realtime_lines(7)
    assert control.startswith(f"{os.SCHED_FIFO} 7 ")
    assert older.startswith(f"{os.SCHED_OTHER} 0 ")
    assert newer.startswith(f"{os.SCHED_OTHER} 0 ")


def test_a_thread_that_spins_loses_its_priority_and_says_so() -> None:
    *_, sentence, control = realtime_lines(7, spin=0.4)
    assert sentence == "computed for 0.05 s without a pause: its real-time priority was taken back"
    assert control.startswith(f"{os.SCHED_OTHER} 0 ")


def test_a_thread_that_pauses_keeps_its_priority() -> None:
    assert realtime_lines(7, spin=0.4, pause=0.001)[-1].startswith(f"{os.SCHED_FIFO} 7 ")


def test_without_being_asked_nothing_has_a_priority() -> None:
    assert Scheduling().realtime_priority == 0
    assert all(line.startswith(f"{os.SCHED_OTHER} 0 ") for line in lines(0))


def test_threads_ask_for_a_short_slice_and_those_that_they_start_do_so_too() -> None:
    if not time_slice(0):
        pytest.skip("the kernel gives all threads the same slice, as before Linux 6.12")
    code = APPLY.format(priority=0, cpus="", spin=0.0, pause=0.0)
    code = code.replace(
        "def scheduled(thread):", "from quadvel_nodes.scheduling import time_slice\ndef scheduled(thread):"
    )
    code = code.replace("return policy,", "return time_slice(thread), policy,")
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert [line.split()[0] for line in result.stdout.splitlines()] == [str(TIME_SLICE_NS)] * 4


def test_every_thread_stays_on_the_cores_that_were_chosen() -> None:
    core = max(os.sched_getaffinity(0))
    assert lines(0, str(core)) == [f"{os.sched_getscheduler(0)} 0 {{{core}}}"] * 4


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"realtime_priority": 100}, "realtime_priority: found 100, expected a whole number, 0 to 99"),
        ({"realtime_priority": -1}, "realtime_priority: found -1, expected a whole number, 0 to 99"),
        ({"cpus": "0,9999"}, "cpus is '0,9999', expected some of "),
        ({"cpus": "two"}, "cpus is 'two', expected some of "),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(parameters: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Scheduling(**parameters)  # type: ignore[arg-type]


YIELDING = """
import os
from pathlib import Path
from quadvel_nodes.scheduling import AUTOGROUP_FILE, run_after_others
run_after_others(10)
print(os.nice(0), AUTOGROUP_FILE.read_text().split()[-1])
"""


@pytest.mark.skipif(
    not (AUTOGROUP_FILE.exists() and AUTOGROUP_FILE.read_text()),
    reason="this kernel does not group processes by session",
)
@pytest.mark.parametrize("own_session", [True, False])
def test_a_process_that_runs_after_others_does_so_across_sessions_where_it_leads_its_own(
    own_session: bool,
) -> None:
    program, ours = [sys.executable, "-c", YIELDING], AUTOGROUP_FILE.read_text().split()[-1]
    done = subprocess.run(program, start_new_session=own_session, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(min(os.nice(0) + 10, 19)), "10" if own_session else ours]
