"""What all tests share: one thread a process, DDS domains of the run's own, and nothing left running."""

from __future__ import annotations

import fcntl
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any

import pytest

# Before anything imports numpy or torch: tests run side by side, one on each core.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

# Processes that a test starts inherit this, wherever they end up in the process tree.
MARK = f"QUADVEL_TEST={os.getpid()}"
os.environ.update([MARK.split("=")])

# Python's own helpers, which live as long as the process that runs the tests.
HELPERS = ("multiprocessing.resource_tracker", "multiprocessing.forkserver")

# A DDS domain that no other worker has, nor a demo or another run of the tests on this machine. All nodes that a
# test starts join it; above 100, DDS would need ports that the system hands out.
DOMAIN_STEP = 4
WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
RUNS = range(1, 25)


def _claim() -> tuple[str, IO[str]]:
    """A number that no other run on this machine has, and the file whose lock holds it until this run ends."""
    for number in random.SystemRandom().sample(RUNS, len(RUNS)):
        try:
            lock = (Path(tempfile.gettempdir()) / f"quadvel-test-run-{number}").open("a")
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # another run has it
            continue
        return str(number), lock
    raise RuntimeError(f"{len(RUNS)} runs of the tests have all DDS domains, expected a free one")


if "QUADVEL_TEST_RUN" not in os.environ:  # a worker has that of its run
    os.environ["QUADVEL_TEST_RUN"], LOCK = _claim()
RUN = os.environ["QUADVEL_TEST_RUN"]
os.environ["ROS_DOMAIN_ID"] = str(DOMAIN_STEP * int(RUN) + WORKER % DOMAIN_STEP)

# Left out where they cannot run: tests of ROS 2's tools without ROS 2, and of both middlewares at once
# where there is but one.
HAS_ROS = "AMENT_PREFIX_PATH" in os.environ or "QUADVEL_ROS_SETUP" in os.environ
collect_ignore = [*([] if HAS_ROS else ["ros"]), *([] if find_spec("rclpy") else ["mixed"])]

# What Hypothesis tries is the same in every run, and takes as long as it takes.
if find_spec("hypothesis"):
    from hypothesis import settings

    settings.register_profile("seeded", deadline=None, derandomize=True)
    settings.load_profile("seeded")

# Tests that start whole stacks of processes, which take more than a core: never two stacks at a time.
STACKS = (
    "end_to_end/",
    "quadvel_view/",
    "quadvel_lab/test_excite.py",
    *(
        f"quadvel_bringup/test_{name}"
        for name in ("listening", "operator", "recorder", "robot_installation", "status", "stopped", "up")
    ),
)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """One worker takes all tests that start stacks; of the others, those of a file stay together."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return "stacks" if any(part in file for part in STACKS) else super()._split_scope(nodeid)

    return Scheduling(config, log) if config.getvalue("dist") == "loadfile" else None


# A run in the background ignores Ctrl-C, and so would what it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def nothing_left_running() -> Iterator[None]:
    """Fails a test that leaves processes behind, and ends them. What wider fixtures started may stay."""
    before = _processes()
    yield
    until = time.monotonic() + 10.0
    while (left := _marked(_processes() - before)) and time.monotonic() < until:
        time.sleep(0.05)
    for pid in left:
        os.kill(int(pid), signal.SIGKILL)
    assert not left, f"left running: {', '.join(sorted(left.values()))}"


@pytest.fixture(autouse=True)
def no_node_outlives_its_context(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A node that refused to start half made would stay on the domain, in the way of the tests that follow."""
    made: list[Any] = []
    kind = getattr(sys.modules.get("rclpy.node"), "Node", None)
    if kind is not None:
        begin = kind.__init__

        @wraps(begin)
        def remember(node: Any, *args: Any, **named: Any) -> None:
            begin(node, *args, **named)
            made.append(node)

        monkeypatch.setattr(kind, "__init__", remember)
    yield
    for node in made:
        if not node.context.ok():
            node.destroy_node()


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    """The main of a node takes signals over for the rest of its process; here other tests follow."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    signal.set_wakeup_fd(socket := signal.set_wakeup_fd(-1))
    yield
    signal.set_wakeup_fd(socket)
    for number, handler in handlers.items():
        signal.signal(number, handler)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _processes() -> set[str]:
    """The ids of all processes."""
    return {name for name in os.listdir("/proc") if name.isdecimal()}


def _marked(processes: set[str]) -> dict[str, str]:
    """Command lines, by process id, of those that this process started, their children included."""
    found = {}
    for pid in processes:
        folder = Path("/proc", pid)
        try:
            environment = (folder / "environ").read_bytes().split(b"\0")
            text = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
        except OSError:  # it has ended meanwhile, or is not ours to look at
            continue
        if MARK.encode() in environment and text and not any(helper in text for helper in HELPERS):
            found[pid] = text
    return found
