"""Wrong and missing files of the benchmarks: one sentence and exit code 2."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("tracking", "enter", "mine", "missing.onnx"), "missing.onnx: no such file"),
        (("tracking", "enter", "mine", "text.onnx"), "text.onnx"),
        (("tracking", "table", "--out", "entries"), "entry.json"),
        (("identification", "enter", "joint_pd", "--folder", "nowhere"), "nowhere/logs: found no log_*.npz"),
        (("identification", "enter", "joint_pd", "--folder", "contest"), "log_000.npz"),
        (("identification", "judge", "--folder", "contest"), "mine.json: found no entrant, logs"),
    ],
)
def test_a_wrong_file_is_named_in_one_sentence(words: tuple[str, ...], sentence: str, tmp_path: Path) -> None:
    for name, text in {
        "text.onnx": "no network",
        "entries/small/mine/entry.json": "no JSON",
        "contest/logs/log_000.npz": "no log",
        "contest/answers/mine.json": '{"schema": 1}',
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    program = f"import sys, runpy; sys.path.insert(0, {str(ROOT)!r}); sys.argv[1:] = {words[1:]!r}; "
    program += f"runpy.run_module('benchmarks.{words[0]}', run_name='__main__')"
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith(f"benchmarks.{words[0]}: ")
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert sentence in done.stderr
