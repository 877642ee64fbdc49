from __future__ import annotations

import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from quadvel_eval import bench
from quadvel_lab import live_bench

MS = 1_000_000  # ns


def _traffic(*rows: tuple[int, int, int]) -> live_bench.Traffic:
    """Messages with stamp, tick and time of publication, ms."""
    return SimpleNamespace(rows=[(stamp * MS, tick, sent * MS) for stamp, tick, sent in rows])  # type: ignore[return-value]


STATES = _traffic((0, 10, 1), (5, 15, 6), (10, 20, 11), (15, 25, 16))


def test_the_answer_time_counts_from_the_publication_of_the_state_to_the_first_answer() -> None:
    answers = _traffic((3, 10, 3), (9, 15, 9), (4, 10, 4))
    assert live_bench.answer_times(STATES, answers, key=1).tolist() == [2000.0, 3000.0, np.inf, np.inf]


def test_late_and_missing_answers_miss_the_deadline_of_one_period_after_the_stamp() -> None:
    times = np.array([2000.0, 4001.0, 3999.0, np.inf])
    assert live_bench.missed_deadlines(STATES, times) == 5000.0


def test_figures_are_per_tick_and_compared_with_the_floor() -> None:
    twice, once = _traffic((3, 10, 3), (8, 15, 8)), _traffic((1, 10, 2), (6, 15, 7))
    by_stamp = _traffic((0, 0, 4), (5, 0, 9))
    used = dict.fromkeys(live_bench.NODES, 0.004) | {"floor": 0.002}
    found = live_bench.run_figures(STATES, {"floor": once, "controller": twice, "estimator": by_stamp}, used)
    assert found["controller_cpu_us"] == 1000.0
    assert found["controller_cpu_ratio"] == 2.0
    assert found["controller_p50_ratio"] == 2.0
    assert found["estimator_p50_ratio"] == 3.0
    assert found["floor_wake_p50_us"] == 0.0
    assert found["stack_cpu_percent"] == pytest.approx(80.0)
    assert {name for name, _, _ in live_bench.live_benchmark(1.0, 0).rows if "sleep" not in name} == set(
        found
    )


def test_the_processor_time_of_another_process_is_counted() -> None:
    computing = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        while live_bench.processor_time(computing.pid) < 0.02:
            pass
    finally:
        computing.kill()
        computing.wait()


def test_the_entry_point_names_the_benchmark() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    for name, value in project["entry-points"][bench.LIVE_GROUP].items():
        assert isinstance(EntryPoint(name, value, bench.LIVE_GROUP).load()(1.0, 0), bench.Benchmark)
