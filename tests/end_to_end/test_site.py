"""The list of versions of the published site."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
write_versions = runpy.run_path(str(ROOT / "docs" / "versions.py"))["write_versions"]


@pytest.fixture
def pages(tmp_path: Path) -> Path:
    """A published site of `main` alone, next to a folder that is no version."""
    for name in ("main", ".git"):
        (tmp_path / name).mkdir()
    (tmp_path / "main" / "index.html").touch()
    return tmp_path


def test_before_the_first_release_visitors_see_the_branch(pages: Path) -> None:
    assert write_versions(pages, "https://example.org") == ["main"]
    assert 'url=main/"' in (pages / "index.html").read_text()


def test_visitors_see_the_newest_release_by_number(pages: Path) -> None:
    for name in ("v0.9.0", "v0.10.0", "v0.10.0-draft"):
        (pages / name).mkdir()
        (pages / name / "index.html").touch()
    assert write_versions(pages, "https://example.org") == ["main", "v0.10.0", "v0.9.0"]
    assert 'url=v0.10.0/"' in (pages / "index.html").read_text()
    menu = json.loads((pages / "switcher.json").read_text())
    assert [entry["url"] for entry in menu][1] == "https://example.org/v0.10.0/"
