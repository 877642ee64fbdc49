"""Processes as torchrun starts them learn as one."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_training import process_group  # noqa: E402

ROOT = Path(__file__).parents[2]


@pytest.fixture
def another(monkeypatch, tmp_path):
    """This process is the first of two; the other one runs."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    for name, value in {"MASTER_ADDR": "localhost", "MASTER_PORT": port, "WORLD_SIZE": 2}.items():
        monkeypatch.setenv(name, str(value))
    other = os.environ | {"RANK": "1", "LOCAL_RANK": "1"}
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("LOCAL_RANK", "0")
    with subprocess.Popen(
        [sys.executable, "-m", "tests.training.half_learner", tmp_path / "run.pt"], env=other, cwd=ROOT
    ) as process:
        try:
            process_group.join("cpu")
            yield process
        finally:
            process_group.destroy_group()
            process.kill()


def test_two_processes_with_half_of_the_robots_each_learn_as_one(another, monkeypatch, tmp_path):
    from tests.training.half_learner import run, update

    together = update(slice(0, 4))
    (weights, grid, command, samples), other = process_group.gather(run(tmp_path / "run.pt"))
    assert samples == other[3] == 3 * 8 * 4
    assert np.array_equal(grid, other[1])
    assert not np.array_equal(command, other[2])
    for name, mine in weights.items():
        assert torch.equal(mine, other[0][name]), name
    assert process_group.broadcast("first") == "first"
    assert process_group.gather("first") == ["first", "second"]
    assert another.wait(30) == 0
    process_group.destroy_group()
    for name, expected in update(slice(0, 8)).items():
        assert torch.allclose(together[name], expected, atol=1e-6), name
