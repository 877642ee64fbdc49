"""Options of `quadvel demo` that one kind of demo has and another has not."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from quadvel_bringup import cli


@pytest.mark.parametrize(
    ("line", "option"),
    [
        ("walk --tour", "--tour"),
        ("--tour", "--tour"),
        ("--world park", "--world"),
        ("--seconds 20", "--seconds"),
        ("walk --metres 5", "--metres"),
        ("--seed 1", "--seed"),
        ("follow --quick", "--quick"),
        ("follow --low-level board", "--low-level"),
        ("follow --loss 0.1", "--loss"),
        ("follow --jitter 2", "--jitter"),
        ("follow --tour --lockstep", "--lockstep"),
        ("follow --actuator mine.yaml", "--actuator"),
        ("follow --video", "--video"),
        ("follow --metres 5", "--metres"),
        ("follow --tour --seconds 20", "--seconds"),
        ("follow --tour --view", "--view"),
        ("follow --tour --video", "--video"),
    ],
)
def test_an_option_without_effect_is_refused(line: str, option: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(cli.app, ["demo", *line.split(), "--out", str(tmp_path / "out")])
    assert isinstance(result.exception, ValueError)
    assert str(result.exception).startswith(f"{option} belongs to ")
    kinds = str(result.exception).partition(", not to ")[0]
    assert kinds.count("demo follow") <= 1
    assert list(tmp_path.iterdir()) == []
