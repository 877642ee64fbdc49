"""Compiled loops are cached on disk; several processes may read and write them concurrently."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

CALL = """
import numpy as np
from quadvel_actuator.effects import recurrence

rows, start, one = np.linspace(0.0, 1.0, 50)[:, None], np.arange(50)[:, None] == 0, np.ones((50, 1))
print(recurrence.backlash_series(rows, start, 0.1)[-1], recurrence.bouc_wen_series(rows, start, 0.5, 0.2)[-1])
print(recurrence.rate_limit_series(rows, 0.0 * one, 0.001 * one, start, 1000.0)[-1])
"""
SEVERAL = 2


@pytest.mark.long
def test_loops_compiled_by_concurrent_processes_serve_later_ones(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "OMP_NUM_THREADS": "1"}
    for together in (SEVERAL, 1):
        calls = [
            subprocess.Popen([sys.executable, "-c", CALL], env=environment, stdout=subprocess.PIPE, text=True)
            for _ in range(together)
        ]
        said = {call.communicate()[0] for call in calls}
        assert [call.returncode for call in calls] == [0] * together
        assert len(said) == 1
