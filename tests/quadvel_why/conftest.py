"""One short recorded walk serves all tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.why.walks import Defect, RecordedWalk


@pytest.fixture(scope="session")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording of a sound robot that walks for a second."""
    recorded = RecordedWalk(Defect(), seed=4)
    assert recorded.run([((0.8, 0.0, 0.8), 1.2)])
    return recorded.messages.write(tmp_path_factory.mktemp("why") / "walk.mcap")
