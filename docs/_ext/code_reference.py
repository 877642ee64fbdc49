"""Parts of reference pages that are written from the code.

A line `<!-- code: NAME -->` of a page is replaced by what the function NAME of `PARTS` returns.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from typer.testing import CliRunner

from quadvel_actuator.effects import registry
from quadvel_bringup import cli
from quadvel_bringup.nodes import NODES
from quadvel_bringup.stack import PARAMETERS

ROOT = Path(__file__).parents[2]
MARK = re.compile(r"^<!-- code: (\w+) -->$", re.MULTILINE)
REFERENCE = ROOT / "docs" / "reference"
KINDS = ("Eq.", "Table", "Figure", "Section")
CITATION = re.compile(r"(Eq\.|Table|Figure|Section) (\d+)")
COLUMNS = 64
"""Width of the help of a command, characters."""


def _fenced(text: str, language: str) -> str:
    return f"```{language}\n{text.rstrip()}\n```\n"


def commands() -> str:
    """Return the help of each command, as `quadvel COMMAND --help` prints it.

    Returns:
        Markdown, with a heading for each command.
    """
    parts = []
    for name in cli.command_names():
        shown = CliRunner().invoke(
            cli.app, [*name.split(), "--help"], terminal_width=COLUMNS, prog_name="quadvel"
        )
        parts.append(f"## quadvel {name}\n\n{_fenced(shown.output, 'text')}")
    return "\n".join(parts)


def nodes() -> str:
    """Return the table of nodes.

    Returns:
        Markdown.
    """
    rows = [
        f"| `{name}` | {entry.about} | `{entry.package}` | `{entry.extra}` |" for name, entry in NODES.items()
    ]
    return "\n".join(["| node | what it does | package | extra |", "|---|---|---|---|", *rows])


def parameters() -> str:
    """Return the parameters of each node, as the shipped file holds them.

    Returns:
        Markdown, with a heading for each node.
    """
    sections = re.split(r"^(\w+):\n", PARAMETERS.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    return "\n".join(
        f"## {node}\n\n" + _fenced(f"{node}:\n{text}", "yaml")
        for node, text in zip(sections[::2], sections[1::2], strict=True)
    )


def messages() -> str:
    """Return the definition of each message and service.

    Returns:
        Markdown, with a heading for each.
    """
    files = sorted(ROOT.glob("src/quadvel_msgs/*/*.[ms][sr][gv]"))
    return "\n".join(
        f"## {file.stem}\n\n{_fenced(file.read_text(encoding='utf-8'), 'text')}" for file in files
    )


def effects() -> str:
    """Return the registry of effects: equation, stage and parameters with their units.

    Returns:
        A Markdown table.
    """
    rows = []
    for name, effect in registry().items():
        first = " ".join((effect.__doc__ or "").partition("\n\n")[0].split()).replace("|", r"\|")
        units = ", ".join(f"`{one.name}` {one.unit}" for one in effect().parameters)
        rows.append(f"| `{name}` | {first} | {units} |")
    return "\n".join(["| effect | equation | parameters |", "|---|---|---|", *rows])


def citations() -> str:
    """Return the places of the code that cite the paper.

    Returns:
        A Markdown table: what is cited, and links to the lines.
    """
    found: dict[tuple[str, int], list[str]] = {}
    for file in sorted([*ROOT.glob("src/**/*.py"), *ROOT.glob("training/**/*.py")]):
        path = file.relative_to(ROOT)
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
            for kind, which in CITATION.findall(line):
                link = f"[{path.stem}:{number}]({os.path.relpath(ROOT / path, REFERENCE)}#L{number})"
                found.setdefault((kind, int(which)), []).append(link)
    order = sorted(found, key=lambda key: (KINDS.index(key[0]), key[1]))
    rows = [f"| {kind} {which} | {', '.join(dict.fromkeys(found[kind, which]))} |" for kind, which in order]
    return "\n".join(["| in the paper | in the code |", "|---|---|", *rows])


PARTS: dict[str, Callable[[], str]] = {
    part.__name__: part for part in (commands, nodes, parameters, messages, effects, citations)
}


def write_parts(app: Sphinx, page: str, source: list[str]) -> None:
    """Replace the marks of a page.

    Args:
        app: The build.
        page: Name of the page.
        source: Its text, the only element; replaced.
    """
    source[0] = MARK.sub(lambda mark: PARTS[mark[1]](), source[0])


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect to the build.

    Args:
        app: The build.

    Returns:
        Properties of the extension.
    """
    app.connect("source-read", write_parts, priority=400)  # before links are resolved
    return {"parallel_read_safe": True}
