"""The recorder of walks is a package under the repository's root; one short walk serves all tests."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))


@pytest.fixture(scope="session")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording of a sound robot that walks for a second."""
    from tests.why.walks import Defect, RecordedWalk

    recorded = RecordedWalk(Defect(), seed=4)
    assert recorded.run([((0.8, 0.0, 0.3), 1.2)])
    return recorded.messages.write(tmp_path_factory.mktemp("why") / "walk.mcap")
