from __future__ import annotations

import os
import sys
from collections.abc import Iterator

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
