"""What all tests share."""

from __future__ import annotations

import runpy
from pathlib import Path


def test_runs_of_the_tests_at_the_same_time_have_domains_of_their_own() -> None:
    claim = runpy.run_path(str(Path(__file__).parent / "conftest.py"))["_claim"]
    claimed = [claim() for _ in range(8)]
    assert len({number for number, _ in claimed}) == 8
    for _, lock in claimed:
        lock.close()
