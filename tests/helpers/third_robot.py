"""The robot of the page "Bring your own robot": other sizes, names and order, rear knees that bend forward."""

from __future__ import annotations

import contextlib
import re
import shlex
from pathlib import Path

from quadvel_bringup import cli

PAGE = Path(__file__).parents[2] / "docs/tutorials/bring-your-own-robot.md"
BASH = "%%bash\n"


def page_cells(first: str, last: str) -> list[str]:
    """The cells of the page from the heading `first` to the heading `last`."""
    text = PAGE.read_text(encoding="utf-8")
    section = text[text.index(f"## {first}\n") : text.index(f"## {last}\n")]
    return re.findall(r"```\{code-cell\}\n(?::tags:[^\n]*\n)?(.*?)```", section, re.S)


def write_third_robot(folder: Path) -> Path:
    """Write `third.xml` by the first cell of the page."""
    with contextlib.chdir(folder):
        exec(page_cells("Check its file", "Complete its folder")[0], {})
    return folder / "third.xml"


def check_third_robot(folder: Path) -> Path:
    """Write `third.xml` and its folder, whose numbers are not complete."""
    write_third_robot(folder)
    command = page_cells("Check its file", "Complete its folder")[1].removeprefix(BASH)
    _, outer, inner, *arguments = shlex.split(command)
    with contextlib.chdir(folder):
        cli.command(f"{outer} {inner}").main(arguments, standalone_mode=False)
    return folder / "out/third"


def complete_third_robot(folder: Path) -> None:
    """Complete the numbers as the page does; `folder`: as for `check_third_robot`."""
    with contextlib.chdir(folder):
        for cell in page_cells("Complete its folder", "Let it stand"):
            if not cell.startswith(BASH):
                exec(cell, {})
