from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from quadvel_eval.pool import run_in_parallel


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """Address of a scheduler with two workers on this machine."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as local:
        yield local.scheduler_address


def test_every_call_is_answered_once_by_another_process_of_this_machine() -> None:
    answers = dict(run_in_parallel([(divmod, k, 3) for k in range(7)] + [(os.getpid,)]))
    assert [answers[k] for k in range(7)] == [divmod(k, 3) for k in range(7)]
    assert answers[7] != os.getpid()


CALLS_FOR_LONG = """
import os, time
from quadvel_eval.pool import run_in_parallel
if __name__ == "__main__":
    for _, answer in run_in_parallel([(os.getpid,), (time.sleep, 600.0), (time.sleep, 600.0)]):
        print(answer, flush=True)
"""


def test_workers_end_with_a_process_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "calls.py").write_text(CALLS_FOR_LONG)
    with subprocess.Popen(
        [sys.executable, tmp_path / "calls.py"], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        worker = int(process.stdout.readline())
        process.kill()
    until = time.monotonic() + 20.0
    while Path(f"/proc/{worker}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()


def test_every_call_is_answered_once_by_a_worker_of_the_cluster(cluster: str) -> None:
    answers = dict(run_in_parallel([(divmod, k, 3) for k in range(7)] + [(os.getpid,)], cluster))
    assert [answers[k] for k in range(7)] == [divmod(k, 3) for k in range(7)]
    assert answers[7] != os.getpid()


def test_what_a_call_raises_on_the_cluster_is_raised_here(cluster: str) -> None:
    with pytest.raises(ZeroDivisionError):
        list(run_in_parallel([(divmod, 1, 0)], cluster))


def test_without_the_package_a_cluster_is_refused_with_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"quadvel-core\[cluster\]"):
        list(run_in_parallel([(divmod, 1, 1)], "tcp://127.0.0.1:1"))
