"""The Markdown of each page next to its HTML, and `llms.txt`, the list of all pages (llmstxt.org)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from code_reference import write_parts
from repository_links import to_repository
from sphinx.application import Sphinx
from sphinx.directives.code import LiteralIncludeReader
from sphinx.environment import BuildEnvironment

INCLUDED = re.compile(r"^```\{literalinclude\} (\S+)\n((?::\w+:.*\n)*)```$", re.MULTILINE)
OPTION = re.compile(r":(\w+): *(.*)")
HEAD = "# quadvel\n\n> Learned velocity control of a quadruped robot on ROS 2.\n"


def pages_below(env: BuildEnvironment, page: str) -> Iterator[str]:
    """List a page and the pages in its tables of contents, in their order.

    Args:
        env: Environment of the build.
        page: Name of the page.

    Yields:
        Names of pages that are written in Markdown.
    """
    if Path(env.doc2path(page)).suffix == ".md":
        yield page
    for part in env.toctree_includes.get(page, ()):
        yield from pages_below(env, part)


def write_markdown(app: Sphinx, error: Exception | None) -> None:
    """Write `PAGE.md` for each page, and `llms.txt`.

    Args:
        app: The build.
        error: What ended the build, or None.
    """
    if error or app.builder.name != "html":
        return
    lines = [HEAD]
    for part in app.env.toctree_includes[app.config.root_doc]:
        lines.append(f"\n## {app.env.titles[part].astext()}\n")
        for page in dict.fromkeys(pages_below(app.env, part)):
            _write_page(app, page)
            lines.append(f"- [{app.env.titles[page].astext()}]({page}.md)")
    Path(app.outdir, "llms.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_page(app: Sphinx, page: str) -> None:
    """Write the Markdown of a page, with the parts that come from the code."""
    path = Path(app.env.doc2path(page))

    def include(found: re.Match[str]) -> str:
        options = dict(OPTION.findall(found[2]))
        file = path.parent / found[1]
        text, _ = LiteralIncludeReader(str(file), options, app.config).read()
        return f"```{options.get('language', file.suffix[1:])}\n{text.rstrip()}\n```"

    source = [INCLUDED.sub(include, path.read_text(encoding="utf-8"))]
    write_parts(app, page, source)
    to_repository(app, page, source)
    target = Path(app.outdir, f"{page}.md")
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(source[0], encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect to the build.

    Args:
        app: The build.

    Returns:
        Properties of the extension.
    """
    app.connect("build-finished", write_markdown)
    return {"parallel_read_safe": True}
