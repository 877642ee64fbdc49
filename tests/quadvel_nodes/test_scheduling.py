"""Real-time priority and cores of a node's threads, seen from outside."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from quadvel_nodes.scheduling import Scheduling

APPLY = """
import os, threading
from quadvel_nodes.scheduling import Scheduling
go = threading.Event()
threading.Thread(target=go.wait).start()
Scheduling(realtime_priority={priority}, cpus="{cpus}").apply(print)
for thread in sorted(os.listdir("/proc/self/task")):
    thread = int(thread)
    print(os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority, os.sched_getaffinity(thread))
go.set()
"""


def lines(priority: int, cpus: str = "") -> list[str]:
    """What a process of its own says after `apply`, a line for each of its two threads at the end."""
    code = APPLY.format(priority=priority, cpus=cpus)
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return result.stdout.splitlines()


def test_every_thread_gets_the_priority_or_a_sentence_says_why_not() -> None:
    *refusal, first, second = lines(7)
    assert first == second
    if refusal:
        assert refusal[0].startswith("runs without real-time priority")
    else:
        assert first.startswith(f"{os.SCHED_FIFO} 7 ")


def test_every_thread_stays_on_the_cores_that_were_chosen() -> None:
    core = max(os.sched_getaffinity(0))
    assert lines(0, str(core)) == [f"{os.sched_getscheduler(0)} 0 {{{core}}}"] * 2


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"realtime_priority": 100}, "realtime_priority is 100, expected 0 to 99"),
        ({"realtime_priority": -1}, "realtime_priority is -1, expected 0 to 99"),
        ({"cpus": "0,9999"}, "cpus is '0,9999', expected some of "),
        ({"cpus": "two"}, "cpus is 'two', expected some of "),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(parameters: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Scheduling(**parameters)  # type: ignore[arg-type]
