"""The closed loop as one command: each step once, with the files of the step before, in any folder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_training import closing


def given(out: Path) -> tuple[str, Path, Path, Path, float, Path]:
    return "drives of the go2", Path("policy.onnx"), Path("dagger.pt"), Path("privileged.pt"), 2.0, out


def test_steps_whose_files_are_there_are_not_run_again(tmp_path, monkeypatch, capsys):
    out, ran = tmp_path / "a loop", []

    def run(command, check):
        assert check
        ran.append(command)
        file = next(file for file, arguments in closing.fill_steps(*given(out)) if arguments == command[1:])
        file.parent.mkdir(exist_ok=True)
        file.touch()

    monkeypatch.setattr(subprocess, "run", run)
    page = closing.close_the_loop(*given(out))
    assert page == out / "gap" / "README.md"
    assert page.exists()
    assert [command[0] for command in ran] == [sys.executable] * 4
    assert "drives of the go2" in ran[0]
    assert str(out / "walk.npz") in ran[0]
    assert str(out / "walk.npz") in ran[1]
    (out / "tuned" / "policy.onnx").unlink()
    closing.close_the_loop(*given(out))
    assert ran[4:] == [ran[2]]
    assert capsys.readouterr().out.count("kept: ") == 3


def test_a_step_that_fails_ends_it(tmp_path, monkeypatch):
    monkeypatch.setattr(closing, "STEPS", (("{out}/never", "-c raise(SystemExit(3))"), ("{out}/x", "-c 0")))
    with pytest.raises(subprocess.CalledProcessError) as failed:
        closing.close_the_loop(*given(tmp_path))
    assert failed.value.returncode == 3
