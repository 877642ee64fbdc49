"""Ctrl-C at the worst moments: before the first line of the program, and while the interpreter ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from quadvel_bringup.nodes import NODES

RUN = "from quadvel_bringup.__main__ import main; main()"
ALONE = {  # nothing goes out to a robot's address, and no port is taken that somebody else may have
    "board": ("--ros-args", "-p", "port:=0"),
    "driver": ("--ros-args", "-p", "dry_run:=true"),
    "view": ("--ros-args", "-p", "port:=0"),
}
USUAL = ("sim_node", "controller", "view")
INTERRUPTED_AT_THE_END = (
    f"import atexit, os, signal; atexit.register(os.kill, os.getpid(), signal.SIGINT); {RUN}"
)


def interrupt_first() -> None:
    """In the child before exec: a SIGINT that waits until the program allows it, as while it starts."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize(
    "arguments",
    [
        ("up",),
        ("drive", "--vx", "0.5"),
        ("record", "--out", "walk.mcap"),
        *(
            pytest.param(("run", name, *ALONE.get(name, ())), marks=() if name in USUAL else pytest.mark.long)
            for name in NODES
        ),
    ],
    ids=" ".join,
)
def test_ctrl_c_during_start_up_ends_a_command_cleanly(arguments: tuple[str, ...], tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", RUN, *arguments],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
        preexec_fn=interrupt_first,
    )
    assert ended.returncode == (1 if "record" in arguments else 0), ended.stderr  # it recorded nothing
    assert "Traceback" not in ended.stderr
    for file in tmp_path.iterdir():
        with file.open("rb") as stream:
            assert make_reader(stream).get_summary() is not None


@pytest.mark.parametrize(
    ("arguments", "code"), [(("drive",), 2), (("record", "--out", "walk.mcap"), 1)], ids=["drive", "record"]
)
def test_ctrl_c_while_the_interpreter_ends_changes_nothing(
    arguments: tuple[str, ...], code: int, tmp_path: Path
) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", INTERRUPTED_AT_THE_END, *arguments, "--seconds", "0.2"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
    )
    assert ended.returncode == code, ended.stderr  # no robot is there
    assert "Traceback" not in ended.stderr


DROPPED_BY_PYTHON = """
import signal, time, typer, weakref
from quadvel_bringup import __main__, cli
class Thing: pass
app = typer.Typer()
@app.command()
def work():
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    thing = Thing()
    reference = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGINT))
    del thing
    time.sleep(60.0)
cli.app = app
__main__.main([])
"""


def test_ctrl_c_in_the_callback_of_a_weak_reference_ends_a_command() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", DROPPED_BY_PYTHON], stderr=subprocess.PIPE, text=True, timeout=40
    )
    assert ended.returncode == 130, ended.stderr
    assert "Traceback" not in ended.stderr
