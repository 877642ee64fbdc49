"""Every command and option of `quadvel`, as the command line itself lists them: help, places to write to, and files to read.

What is wrong is said in one sentence, with exit code 2, before any work begins; nothing is left behind.
"""

from __future__ import annotations

import inspect
import json
import re
import signal
import subprocess
import sys
import typing
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest

from quadvel_bringup import cli
from quadvel_bringup.__main__ import main
from quadvel_eval.grid import SCHEMA
from tests.quadvel_sysid.joint_logs import fields, mcap

COMMANDS = tuple(cli.command_names())
LONGEST = 60  # s, in which a command has to see what is wrong with its arguments
NAMES_OR_FILES = {("world", "world"), ("twin", "plants")}
"""Arguments that take the name of something shipped, or a file"""
LOG = "log.npz"
EVALUATION = "eval.json"
NEEDED = {
    ("calibrate", "--out"): ["--suspended", "suspended.mcap"],
    "compare": [EVALUATION, EVALUATION],
    "demo": ["--no-video"],
    ("demo", "--world"): ["follow"],
    "eval": ["--grid", "quick"],
    "excite": ["steps"],
    "identify": [LOG],
    ("people", "--scans"): ["--runs", "0"],
    ("people", "--out"): ["--runs", "0"],
    "plot": ["walk.mcap"],
    "policy import": ["policy.onnx"],
    "replay": ["walk.mcap"],
    "robot check": ["robot.xml"],
    "run": ["sim_node"],
    "twin": ["dry_gears"],
    "why": [LOG],
    "world": ["park"],
}
"""What a command, or one of its options, needs besides the value that is wrong"""


class TooLongError(BaseException):
    """A command went to work instead of refusing what is wrong."""


@attrs.frozen
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


@attrs.frozen
class Place:
    """A parameter of a command that takes a path."""

    command: str
    option: str  # as it is typed; of an argument its name
    is_argument: bool

    def __str__(self) -> str:
        return f"{self.command} {self.option}"

    def line(self, value: str) -> list[str]:
        """A command line on which this parameter alone is wrong."""
        needed = NEEDED.get((self.command, self.option), NEEDED.get(self.command, []))
        if not self.is_argument:
            return [*self.command.split(), *needed, self.option, value]
        index = [p.name for p in parameters(self.command) if p.param_type_name == "argument"].index(
            self.option
        )
        return [*self.command.split(), *needed[:index], value, *needed[index + 1 :]]


def parameters(name: str) -> list[Any]:
    return list(cli.command(name).params)


def types(name: str) -> dict[str, str]:
    """The types of a command's parameters as they are written in its function."""
    callback = cli.command(name).callback
    assert callback is not None
    return {key: str(hint) for key, hint in typing.get_type_hints(inspect.unwrap(callback)).items()}


def places(writes: bool) -> list[Place]:
    """Every parameter that takes a path, to write to or to read."""
    found = []
    for name in COMMANDS:
        hints = types(name)
        for parameter in parameters(name):
            named = (name, parameter.name) in NAMES_OR_FILES or "file" in (parameter.metavar or "")
            if (named or "Path" in hints.get(parameter.name, "")) and writes == (parameter.name == "out"):
                is_argument = parameter.param_type_name == "argument"
                found.append(Place(name, parameter.name if is_argument else parameter.opts[0], is_argument))
    return found


@contextmanager
def at_most(seconds: int) -> Iterator[None]:
    def end(*_: object) -> None:
        raise TooLongError

    former = signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, former)


@pytest.fixture
def quadvel(
    capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Ended]]:
    """Runs the command line in this process, in a folder of its own that holds a log and an evaluation."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("QUADVEL_TRACEBACK", raising=False)
    write_log(tmp_path / LOG)
    (tmp_path / EVALUATION).write_text(json.dumps({"schema": SCHEMA, "cells": []}))

    def run(*arguments: str) -> Ended:
        if arguments[0] == "run" and "--help" not in arguments:  # a node's signals are its process's
            line = [sys.executable, "-m", "quadvel_bringup", *arguments]
            process = subprocess.run(line, capture_output=True, text=True, timeout=LONGEST)
            return Ended(process.returncode, process.stdout, process.stderr)
        with pytest.raises(SystemExit) as ended, at_most(LONGEST):
            main(arguments)
        written = capfd.readouterr()
        code = ended.value.code
        return Ended(code if isinstance(code, int) else 1, written.out, written.err)

    yield run
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def write_log(path: Path) -> None:
    """A log of a motion that nothing is wrong with."""
    time = 0.005 * np.arange(400)
    phase = 6.0 * time[:, None] + np.arange(12)
    q, dq, q_des = 0.4 * np.sin(phase), 2.4 * np.cos(phase), 0.4 * np.sin(phase + 0.5)
    gains = {"kp": np.full_like(q, 30.0), "kd": np.full_like(q, 0.5)}
    np.savez(path, t=time, q=q, dq=dq, q_des=q_des, tau=30.0 * (q_des - q) - 0.5 * dq, **gains)


def is_refused(ended: Ended, sentence_about: str) -> None:
    """In one sentence that names what is wrong, with exit code 2."""
    assert ended.code == 2, ended.err
    assert "Traceback" not in ended.err
    said = [line for line in ended.err.splitlines() if sentence_about in line]
    assert len(said) == 1, ended.err
    assert re.search(r"\[Errno|<class|0x[0-9a-f]{6}", said[0]) is None, said


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_plain_text(name: str, quadvel: Callable[..., Ended]) -> None:
    shown = quadvel(*name.split(), "--help")
    assert shown.code == 0
    assert re.findall(r"[^\n -~]|\\b", shown.out) == []


@pytest.mark.parametrize("name", COMMANDS)
def test_values_have_names_of_one_style(name: str, quadvel: Callable[..., Ended]) -> None:
    """Options name them in angle brackets, as typer does; arguments by a word in lower case."""
    style = re.compile(r"<[a-z]+( [a-z]+)*(\|[a-z_]+)*(=[a-z]+)?(\.\.\.)?>")
    words = {True: re.compile("[a-z]+"), False: style}
    for parameter in parameters(name):
        if parameter.metavar is not None:
            assert words[parameter.param_type_name == "argument"].fullmatch(parameter.metavar), parameter
        elif parameter.param_type_name != "argument" and "Path" in types(name).get(parameter.name, ""):
            pytest.fail(f"{parameter.opts[0]}: <file> or <folder>?")


@pytest.mark.parametrize("name", COMMANDS)
def test_results_go_to_a_folder_named_out_unless_another_is_given(name: str) -> None:
    for parameter in parameters(name):
        if parameter.name == "out":
            assert not parameter.required
            default = parameter.show_default if parameter.default is None else str(parameter.default)
            assert all(part.startswith("out/") for part in default.split(", ")), default


@pytest.mark.parametrize("place", places(writes=True), ids=str)
@pytest.mark.parametrize("where", ["/proc/f/x.png", "file/x.png", "file"])
def test_a_place_that_cannot_be_written_to_is_refused(
    place: Place, where: str, quadvel: Callable[..., Ended], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("kept")
    if where == "file" and "folder" not in metavar(place):
        (tmp_path / "file").unlink()
        (tmp_path / "file").mkdir()
    before = sorted(tmp_path.iterdir())
    line = place.line(where)
    is_refused(quadvel(*line), where)
    assert sorted(tmp_path.iterdir()) == before


def metavar(place: Place) -> str:
    return str(next(p.metavar for p in parameters(place.command) if p.opts[0] == place.option))


def missing(path: Path) -> None:
    pass


def folder(path: Path) -> None:
    path.mkdir()


def empty(path: Path) -> None:
    path.touch()


def garbage(path: Path) -> None:
    path.write_bytes(np.random.default_rng(1).bytes(2000))


def text(path: Path) -> None:
    path.write_text("neither a number nor a key\n")


def list_of_numbers(path: Path) -> None:
    path.write_text("[1, 2, 3]")


WRONG = (missing, folder, empty, garbage, text, list_of_numbers)


def suffixes(place: Place) -> tuple[str, ...]:
    """Names under which a parameter's file may come: readers choose by them."""
    if "onnx" in place.option or place.option in ("--policy", "--estimator-file", "--model", "weights"):
        return (".onnx",)
    if place.command in ("identify", "plot", "replay", "calibrate", "view", "why") and place.option in (
        "logs", "--holdout", "recording", "--suspended", "--standing"
    ):  # fmt: skip
        return (
            (".mcap", ".npz", ".csv", ".json", "") if place.command in ("identify", "why") else (".mcap", "")
        )
    if place.option in ("first", "second", "--after"):
        return (".json",)
    if place.command == "robot check":
        return (".xml", ".urdf")
    return (".xml", ".urdf", ".yaml") if place.option == "--robot" else (".yaml",)


READ = [
    (place, suffix, make)
    for place in places(writes=False)
    for suffix in suffixes(place)
    for make in ((missing, garbage) if place.command == "run" else WRONG)  # run is a process of its own
]


@pytest.mark.parametrize(
    ("place", "suffix", "make"), READ, ids=lambda one: getattr(one, "__name__", str(one) or "none")
)
def test_a_file_that_is_not_what_it_should_be_is_refused(
    place: Place, suffix: str, make: Callable[[Path], None], quadvel: Callable[..., Ended], tmp_path: Path
) -> None:
    path = tmp_path / f"given{suffix}"
    make(path)
    if place.command == "replay":
        mcap(tmp_path / "walk.mcap", fields(seconds=0.2))
    before = sorted(tmp_path.iterdir())
    value = f"mine={path}" if "=" in metavar_of(place) else str(path)
    is_refused(quadvel(*place.line(value)), path.name)
    assert sorted(tmp_path.iterdir()) == before


def metavar_of(place: Place) -> str:
    found = [p for p in parameters(place.command) if place.option in (p.name, *p.opts)]
    return found[0].metavar or ""
