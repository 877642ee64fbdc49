"""The command line of training on a machine without PyTorch."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("words", [("--help",), ("limit", "--help")])
def test_without_torch_one_sentence_says_what_to_install(words: tuple[str, ...], tmp_path: Path) -> None:
    hidden = "raise ModuleNotFoundError(\"No module named 'torch'\", name='torch')"
    (tmp_path / "torch.py").write_text(hidden)
    start = f"import sys, runpy; sys.path.insert(0, {str(tmp_path)!r}); sys.argv[1:] = {words!r}; "
    start += "runpy.run_module('quadvel_training', run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", start], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "pip install -c requirements.lock -e '.[train]'" in done.stderr
