"""Recordings that were cut off, as the command line reports them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from quadvel_bringup.recording_file import RawMessage, RecordingFile
from quadvel_recordings.definitions import STORE

COMMAND = "quadvel_msgs/msg/VelocityCommand"


@pytest.fixture(scope="module")
def truncated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two chunks of commands, without the end of the file."""
    path = tmp_path_factory.mktemp("cut") / "walk.mcap"
    time, vector = (
        STORE.types[f"{name}"] for name in ("builtin_interfaces/msg/Time", "geometry_msgs/msg/Vector3")
    )
    twist = STORE.types["geometry_msgs/msg/Twist"](vector(0.5, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    file = RecordingFile(path)
    for k in range(400):
        message = STORE.types[COMMAND](
            stamp=time(k // 200, 5_000_000 * (k % 200)), twist=twist, stance=False, source="follow"
        )
        data = bytes(STORE.serialize_cdr(message, COMMAND))
        file.keep(RawMessage("/command", COMMAND, 5_000_000 * k, 5_000_000 * k, data))
        if k == 200:
            file._writer.flush()
    file.close()
    os.truncate(path, path.stat().st_size // 2)
    return path


def test_what_is_kept_is_drawn_and_one_line_says_so(truncated: Path, tmp_path: Path) -> None:
    line = [sys.executable, "-m", "quadvel_bringup", "plot", str(truncated), "--out", str(tmp_path / "out")]
    ended = subprocess.run(line, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "out" / "velocity.png").exists()
    warned = ended.stderr.splitlines()
    assert len(warned) == 1, warned
    assert warned[0].startswith(f"quadvel: warning: {truncated}: ")
    assert ".py:" not in ended.stderr
