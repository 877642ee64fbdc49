"""Fixtures: recordings of people, if they are available."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import quadvel_dds

quadvel_dds.install()


@pytest.fixture(scope="session")
def scans() -> Path:
    """The folder with scans of people; skips where there is none."""
    folder = Path(os.environ.get("QUADVEL_MEASURED", "nowhere"))
    if not (folder / "legs_none.npz").is_file():
        pytest.skip("QUADVEL_MEASURED names no folder with legs_none.npz, scans of people")
    return folder
