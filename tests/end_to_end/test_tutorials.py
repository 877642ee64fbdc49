"""Every cell of every page that the site executes runs, page by page, without a notebook."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TERMINAL = ROOT / "docs" / "_ext" / "terminal.py"
CELL = re.compile(r"^```\{code-cell\}[^\n]*\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
OPTION = re.compile(r":[\w-]+:.*\n|---\n.*?---\n", re.DOTALL)
PAGES = [path for path in sorted(ROOT.glob("docs/**/*.md")) if CELL.search(path.read_text())]
WITHOUT_NOTEBOOK = """
import sys, types
magics = sys.modules["IPython.core.magic"] = types.ModuleType("IPython.core.magic")
magics.register_cell_magic = lambda function: function
sys.modules["IPython"] = sys.modules["IPython.core"] = types.ModuleType("IPython")
"""


def script(page: Path) -> str:
    """The cells of a page as one program."""
    lines = [WITHOUT_NOTEBOOK, f"exec(compile(open({str(TERMINAL)!r}).read(), 'terminal.py', 'exec'))"]
    for match in CELL.finditer(page.read_text()):
        text = re.sub(r"\A(:[\w-]+:[^\n]*\n)+", "", match["text"])
        is_bash = text.startswith("%%bash\n")
        lines.append(f"bash('', {text.partition(chr(10))[2]!r})" if is_bash else text)
    return "\n".join(lines)


@pytest.mark.tutorial
@pytest.mark.parametrize("page", PAGES, ids=[path.stem for path in PAGES])
def test_a_page_runs_from_its_first_cell_to_its_last(page: Path, tmp_path: Path) -> None:
    environment = os.environ | {
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "QUADVEL": str(ROOT),
        "MPLBACKEND": "agg",
    }
    ended = subprocess.run(
        [sys.executable, "-c", script(page)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
