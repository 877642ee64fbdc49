"""The command line as a user meets it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from quadvel_bringup import cli

COMMANDS = tuple(typer.main.get_group(cli.app).commands)


def quadvel(*arguments: str) -> subprocess.CompletedProcess[str]:
    program = "from quadvel_bringup.__main__ import main; main()"
    return subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True)


def test_help_shows_examples_and_every_command_in_a_panel_on_one_screen() -> None:
    text = CliRunner().invoke(cli.app, ["--help"]).output
    lines = text.splitlines()
    assert [command for command in COMMANDS if f"\n  {command} " not in text] == []
    assert [line.split()[0] for line in lines[1:4]] == ["quadvel"] * 3
    assert [line for line in lines if line in cli.PANELS] == list(cli.PANELS)
    assert len(lines) <= 40
    assert [line for line in lines if len(line) > 80 or line.endswith("...")] == []


@pytest.mark.parametrize(
    ("command", "example"),
    [
        ("run", "quadvel run sim_node --ros-args -p terrain:=rough"),
        ("up", "quadvel drive --vx 0.5"),
        ("drive", "quadvel drive --vx 0.5 --wz 0.3 --seconds 5"),
        ("record", "quadvel record low_state low_cmd --out walk.mcap"),
    ],
)
def test_the_help_of_a_command_shows_an_example(command: str, example: str) -> None:
    result = CliRunner().invoke(cli.app, [command, "--help"])
    assert result.exit_code == 0
    assert f"  {example}\n" in result.output


def test_the_version_names_the_commit_of_a_source_tree() -> None:
    assert re.fullmatch(r"quadvel \d+\.\d+\.\d+( \(commit \w+(, changed)?\))?\n", quadvel("--version").stdout)


def test_a_shell_completes_commands_and_options() -> None:
    def completed(words: str) -> list[str]:
        asked = {
            "_QUADVEL_COMPLETE": "complete_bash",
            "COMP_WORDS": words,
            "COMP_CWORD": str(words.count(" ")),
        }
        program = [sys.executable, "-m", "quadvel_bringup"]
        return subprocess.run(
            program, env={**os.environ, **asked}, capture_output=True, text=True
        ).stdout.split()

    assert completed("quadvel de") == ["demo"]
    assert completed("quadvel drive --v") == ["--vx", "--vy"]
    assert "--show-completion" in completed("quadvel --s")


def test_help_loads_no_simulator_and_no_middleware() -> None:
    program = (
        "import sys; from quadvel_bringup import cli; "
        "print([m for m in ('mujoco', 'onnxruntime', 'cyclonedds', 'numpy', 'torch') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout == "[]\n"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["run", "pilot"], "quadvel: there is no node 'pilot'; known nodes: sim_node"),
        (
            ["run", "sim_node", "terrain:=rough", "--actuator", "mine.yaml"],
            "quadvel: unexpected argument 'terrain:=rough'; set parameters by --ros-args",
        ),
        (
            ["run", "sim_node", "--fast"],
            "quadvel: unexpected argument '--fast'; set parameters by --ros-args",
        ),
        (["up", "--low-level", "spot"], "'spot' is not one of 'sim', 'board'"),
        (["fly"], "No such command 'fly'"),
    ],
)
def test_a_wrong_call_ends_in_one_sentence_and_exit_code_2(arguments: list[str], sentence: str) -> None:
    result = quadvel(*arguments)
    assert (result.returncode, result.stdout) == (2, "")
    assert sentence in result.stderr
    assert "Traceback" not in result.stderr


def test_a_topic_that_is_no_name_is_refused_in_one_sentence() -> None:
    result = quadvel("drive", "--vx", "0.4", "--topic", "bad topic")
    assert result.returncode == 2
    assert result.stderr.startswith("quadvel: --topic: ")


@pytest.mark.parametrize("command", [["record"], ["excite", "chirp"]])
def test_a_recording_has_the_suffix_by_which_it_is_read(command: list[str], tmp_path: Path) -> None:
    result = quadvel(*command, "--out", str(tmp_path / "walk.txt"))
    assert result.returncode == 2
    assert "walk.txt: the suffix is '.txt', expected .mcap" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_recording_replaces_no_file(tmp_path: Path) -> None:
    file = tmp_path / "walk.mcap"
    file.write_text("kept")
    result = quadvel("record", "--out", str(file))
    assert (result.returncode, result.stderr) == (2, f"quadvel: {file} exists already; name another file\n")
    assert file.read_text() == "kept"


def test_arguments_of_other_packages_commands_are_handed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    module = type(sys)("quadvel_eval.cli")
    seen: list[tuple[int, str]] = []

    def bench_command(times: int, out: str) -> None:
        """What bench does."""
        seen.append((times, out))

    module.bench_command = bench_command  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "quadvel_eval.cli", module)
    result = CliRunner().invoke(cli.app, ["bench", "3", "here"])
    assert (result.exit_code, seen) == (0, [(3, "here")])
    assert "What bench does." in CliRunner().invoke(cli.app, ["bench", "--help"]).output


def test_doctor_says_what_is_there_and_what_can_run() -> None:
    result = CliRunner().invoke(cli.app, ["doctor"])
    assert result.exit_code == 0
    subjects = [line.split()[1] for line in result.output.splitlines() if line.startswith(("ok", "note"))]
    assert subjects[:3] == ["Python", "cores", "ROS"]
    assert {"mujoco", "onnxruntime", "cyclonedds", "wake-up", "GL", "torch"} <= set(subjects)
    assert "can run quadvel demo, up, run, record" in result.output
