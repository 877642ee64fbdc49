"""Processes as torchrun starts them learn as one."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel[train]'")

from quadvel_training import parallel  # noqa: E402

HERE = Path(__file__).parent


@pytest.fixture
def another(monkeypatch):
    """This process is the first of two; the other one runs."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    for name, value in {"MASTER_ADDR": "localhost", "MASTER_PORT": port, "WORLD_SIZE": 2}.items():
        monkeypatch.setenv(name, str(value))
    other = os.environ | {"RANK": "1", "LOCAL_RANK": "1"}
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("LOCAL_RANK", "0")
    with subprocess.Popen([sys.executable, HERE / "half_learner.py"], env=other) as process:
        try:
            parallel.join("cpu")
            yield process
        finally:
            parallel.leave()
            process.kill()


def test_two_processes_with_half_of_the_robots_each_take_the_step_of_one_with_all(another, monkeypatch):
    monkeypatch.syspath_prepend(HERE)
    from half_learner import update

    together = update(slice(0, 4))
    assert parallel.from_first("first") == "first"
    assert parallel.gather("first") == ["first", "second"]
    assert another.wait(30) == 0
    parallel.leave()
    for name, expected in update(slice(0, 8)).items():
        assert torch.allclose(together[name], expected, atol=1e-6), name
