"""Processes that live and die together."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from quadvel_bringup.processes import ProcessGroup

SLEEPER = [
    sys.executable,
    "-c",
    "import signal, time; signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT}); time.sleep(60)",
]
# Deaf to the gentle ways, as a node that hangs.
STUBBORN = """
import signal, time
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_IGN)
print("up")
time.sleep(60)
"""
# Ends with 7 at the first Ctrl-C and would end with 8 at a second one.
COUNTING = """
import signal, sys, time
def stop(number, frame):
    signal.signal(signal.SIGINT, lambda *_: sys.exit(8))
    time.sleep(0.3)
    sys.exit(7)
signal.signal(signal.SIGINT, stop)
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
print("up")
time.sleep(60)
"""


class Lines:
    """Output that remembers what was written."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, str]] = []

    def __call__(self, name: str, line: str) -> None:
        self.seen.append((name, line))


def wait_until(holds: Callable[[], bool], seconds: float = 20.0) -> None:
    until = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.02)


def test_output_comes_line_by_line_under_the_name_of_its_process() -> None:
    lines = Lines()
    with ProcessGroup(lines) as group:
        group.start(
            "talker", [sys.executable, "-c", "import sys; print('one'); print('two', file=sys.stderr)"]
        )
        wait_until(lambda: bool(group.ended()))
    assert sorted(lines.seen) == [("talker", "one"), ("talker", "two")]


def test_a_process_that_ended_is_named_with_its_exit_code() -> None:
    with ProcessGroup(Lines()) as group:
        group.start("stays", SLEEPER)
        group.start("leaves", [sys.executable, "-c", "raise SystemExit(3)"])
        wait_until(lambda: bool(group.ended()))
        assert group.ended() == {"leaves": 3}


def test_stop_sends_one_interrupt() -> None:
    lines = Lines()
    with ProcessGroup(lines) as group:
        group.start("counting", [sys.executable, "-c", COUNTING])
        wait_until(lambda: ("counting", "up") in lines.seen)
        assert group.stop() == {"counting": 7}


def test_an_interrupt_waits_until_the_process_allows_it() -> None:
    late = COUNTING.replace("signal.pthread", "time.sleep(0.5)\nsignal.pthread")
    with ProcessGroup(Lines()) as group:
        group.start("late", [sys.executable, "-c", late])
        assert group.stop() == {"late": 7}


def test_stop_kills_what_does_not_listen() -> None:
    lines = Lines()
    with ProcessGroup(lines) as group:
        group.start("stubborn", [sys.executable, "-c", STUBBORN])
        wait_until(lambda: ("stubborn", "up") in lines.seen)
        assert group.stop(patience=0.2) == {"stubborn": -signal.SIGKILL}


def test_an_error_in_the_block_stops_the_processes() -> None:
    group = ProcessGroup(Lines())
    group.start("sleeper", SLEEPER)
    with pytest.raises(RuntimeError, match="on purpose"), group:
        raise RuntimeError("on purpose")
    assert group.ended().keys() == {"sleeper"}


def test_a_name_is_given_once() -> None:
    with ProcessGroup(Lines()) as group:
        group.start("sleeper", SLEEPER)
        with pytest.raises(ValueError, match="'sleeper' runs already"):
            group.start("sleeper", SLEEPER)


def test_processes_end_when_the_one_that_started_them_is_killed(tmp_path: Path) -> None:
    silent = [
        sys.executable,
        "-c",
        "import time; time.sleep(60)",
    ]  # the closed pipe would end one that writes
    program = f"""
import os
from quadvel_bringup.processes import ProcessGroup
with ProcessGroup(lambda name, line: None) as group:
    group.start("sleeper", {silent!r})
    print(group._processes["sleeper"].pid, flush=True)
    os.kill(os.getpid(), 9)
"""
    parent = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert parent.returncode == -signal.SIGKILL
    child = Path("/proc") / parent.stdout.strip()
    wait_until(lambda: not (child / "cmdline").exists() or not (child / "cmdline").read_bytes())


def _alone(program: str) -> None:
    """Run `program` in a process of one thread: in a test runner a signal may come to any thread."""
    head = "import os, signal\nfrom quadvel_bringup.processes import StopSignals\n"
    subprocess.run([sys.executable, "-c", head + textwrap.dedent(program)], check=True, timeout=60)


def test_stop_signals_are_noted_and_not_raised_however_often_they_come() -> None:
    _alone("""
        former = signal.getsignal(signal.SIGTERM)
        with StopSignals() as signals:
            assert not signals.wait(0.0)
            for number in (signal.SIGTERM, signal.SIGINT, signal.SIGINT):
                os.kill(os.getpid(), number)
            assert signals.wait(1.0)
            assert signals.received == signal.SIGTERM
        assert signal.getsignal(signal.SIGTERM) is former
        os.kill(os.getpid(), signal.SIGINT)  # does not come through to the clean-up that follows
        assert signal.sigtimedwait({signal.SIGINT}, 1.0) is not None
    """)


def test_a_thread_that_began_among_stop_signals_lets_none_through_at_the_end() -> None:
    _alone("""
        import threading, time
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        with StopSignals() as signals:
            threading.Thread(target=time.sleep, args=(0.5,)).start()
        assert not signals.received
        os.kill(os.getpid(), signal.SIGINT)  # the thread has not blocked it
        time.sleep(0.1)
    """)


def test_stop_signals_hear_what_was_held_back_and_hold_back_again() -> None:
    _alone("""
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        os.kill(os.getpid(), signal.SIGINT)
        with StopSignals() as signals:
            assert signals.received == signal.SIGINT
        os.kill(os.getpid(), signal.SIGINT)
        assert signal.sigtimedwait({signal.SIGINT}, 1.0) is not None
    """)
