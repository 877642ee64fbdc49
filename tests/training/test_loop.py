"""What a training run shows of itself while it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")

from quadvel_training import loop  # noqa: E402

FIGURES = {
    "error_xy": 0.211,
    "error_wz": 0.286,
    "falls_per_minute": 12.5,
    "broken": 0.0,
    "contact_ratio": 0.987,
    "reward": 0.0123,
    "reward/velocity": 0.5,
    "followed": 0.0456,
}


class TwoUpdates:
    """A run that is over after two updates."""

    samples = 0

    def step(self, done: float) -> dict[str, float]:
        self.samples += 1
        return FIGURES

    def state(self) -> dict[str, Any]:
        return {"samples": self.samples}

    def restore(self, state: dict[str, Any]) -> None:
        self.samples = state["samples"]


def shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert loop.train(TwoUpdates(), loop.Budget(samples=2, minutes=1.0), tmp_path / "privileged.pt")
    return capsys.readouterr().out


def test_the_progress_line_shows_the_first_figures_in_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    line = shown(tmp_path, capsys).splitlines()[-1]
    assert line.startswith("privileged ")
    assert "followed 0.0456  error_xy 0.211" in line
    assert "…" not in line
    assert len(line.rstrip()) <= 80


def test_the_line_of_each_minute_shows_all_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(loop, "SAVE_INTERVAL_S", 0.0)
    line = next(line for line in shown(tmp_path, capsys).splitlines() if "M samples" in line)
    assert all(f"{name} " in line for name in FIGURES if "/" not in name)
    assert "reward/velocity" not in line
