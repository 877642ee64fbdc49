"""The robot of the page "Bring your own robot": other sizes, names and order, rear knees that bend forward."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs/tutorials/bring-your-own-robot.md"


def write_third_robot(folder: Path) -> Path:
    """Write `third.xml` by the cell of the page."""
    cells = re.findall(
        r"```\{code-cell\}\n(?::tags:[^\n]*\n)?(.*?)```", PAGE.read_text(encoding="utf-8"), re.S
    )
    cell = next(cell for cell in cells if "third.xml" in cell and "%%bash" not in cell)
    with contextlib.chdir(folder):
        exec(cell, {})
    return folder / "third.xml"
