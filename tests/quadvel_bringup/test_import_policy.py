"""`quadvel policy import` as a command: it never writes over what it reads."""

from __future__ import annotations

from pathlib import Path

import pytest

from quadvel_bringup.import_policy import import_command


@pytest.mark.parametrize("out", ["policy.onnx", "deploy.yaml"])
def test_a_file_that_is_read_is_not_written_over(out: str, tmp_path: Path) -> None:
    weights, config = tmp_path / "policy.onnx", tmp_path / "deploy.yaml"
    weights.write_bytes(b"weights")
    config.write_text("step_dt: 0.02")
    with pytest.raises(ValueError, match=f"--out: found .*{out}, a file that is read"):
        import_command(weights, tmp_path / "x" / ".." / out, "go2", config, None, None)
    assert weights.read_bytes() == b"weights"
    assert config.read_text() == "step_dt: 0.02"
