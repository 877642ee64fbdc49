"""The command `quadvel identify`: help, refusals, and the files it writes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from quadvel_sysid import cli
from tests.quadvel_sysid.joint_logs import fields, mcap, npz


def test_help_shows_an_example_and_the_fields_of_a_log() -> None:
    text = CliRunner().invoke(cli.app, ["--help"]).output
    assert "  quadvel identify walk.mcap --out out/identify\n" in text
    assert "t_cmd (M,) with q_des_cmd (M, J)" in text


def test_all_logs_after_holdout_are_held_out() -> None:
    arguments = ["a", "--holdout", "b", "c", "--out", "d", "--gains", "1", "2"]
    expected = ["a", "--holdout", "b", "--holdout", "c", "--out", "d", "--gains", "1", "2"]
    assert list(cli._repeat_options(arguments)) == expected


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"q": None}, "log.npz: q: the field is missing"),
        ({"dq": -fields()["dq"]}, "log.npz: dq: has the opposite sign"),
    ],
)
def test_a_refusal_is_one_sentence_and_writes_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    changes: dict[str, object],
    sentence: str,
) -> None:
    out = tmp_path / "out"
    log = npz(tmp_path / "log.npz", **changes)
    monkeypatch.setattr(sys, "argv", ["identify", str(log), "--out", str(out)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith(f"identify: {tmp_path}/{sentence}")
    assert not out.exists()


@pytest.mark.parametrize("again", [[], ["--holdout"]])
def test_a_log_that_is_fitted_is_not_held_out_as_well(
    again: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(npz(tmp_path / "log.npz"))
    monkeypatch.setattr(sys, "argv", ["identify", log, *again, log, "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    assert "log.npz: named twice" in capsys.readouterr().err


def test_a_robot_that_does_not_exist_is_refused_before_the_logs_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(tmp_path / "missing.npz")
    monkeypatch.setattr(sys, "argv", ["identify", log, "--robot", "no_robot", "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert "no_robot" in error
    assert "missing.npz" not in error


def test_recordings_are_read_where_no_middleware_is_installed(tmp_path: Path) -> None:
    recording = mcap(tmp_path / "walk.mcap", fields() | {"dq": -fields()["dq"]})
    program = (
        "import runpy, sys\n"
        "sys.modules |= {'cyclonedds': None, 'rclpy': None}  # their import fails\n"
        "sys.argv = ['quadvel', 'identify', *sys.argv[1:]]\n"
        "runpy.run_module('quadvel_bringup', run_name='__main__')"
    )
    command = [sys.executable, "-c", program, str(recording), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert f"{recording}: dq: has the opposite sign" in done.stderr


def test_a_heldout_log_with_other_joints_is_refused(tmp_path: Path) -> None:
    given = {name: fields()[name][:, :3] for name in ("q", "dq", "q_des", "tau")}
    few = npz(tmp_path / "few.npz", **given, joint_names=["FR_hip", "FR_thigh", "FR_calf"])
    all_ = npz(tmp_path / "all.npz")
    arguments = [str(all_), "--holdout", str(few), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(cli.app, arguments)
    assert "few.npz: joint_names: no 'FL_hip_joint'" in str(result.exception)


def test_ctrl_c_leaves_the_folder_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "read_log", interrupted)
    kept = tmp_path / "out" / "kept"
    kept.parent.mkdir()
    kept.write_text("kept")
    result = CliRunner().invoke(cli.app, [str(npz(tmp_path / "a.npz")), "--out", str(kept.parent)])
    assert result.exit_code == 130
    assert [file.name for file in kept.parent.iterdir()] == ["kept"]
