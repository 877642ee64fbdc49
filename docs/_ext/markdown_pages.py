"""The Markdown of each page next to its HTML, and `llms.txt`, the list of all pages (llmstxt.org)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from code_reference import write_parts
from repository_links import to_repository
from sphinx.application import Sphinx


def write_markdown(app: Sphinx, error: Exception | None) -> None:
    """Write `PAGE.md` for each Markdown page, and `llms.txt`.

    Args:
        app: The build.
        error: What ended the build, or None.
    """
    if error or app.builder.name != "html":
        return
    lines = [f"# {app.config.project}", "", "> Learned velocity control of a quadruped robot on ROS 2.", ""]
    for page in sorted(app.env.found_docs):
        path = Path(app.env.doc2path(page))
        if path.suffix != ".md":
            continue
        source = [path.read_text(encoding="utf-8")]
        write_parts(app, page, source)
        to_repository(app, page, source)
        target = Path(app.outdir, f"{page}.md")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(source[0], encoding="utf-8")
        lines.append(f"- [{app.env.titles[page].astext()}]({page}.md)")
    Path(app.outdir, "llms.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect to the build.

    Args:
        app: The build.

    Returns:
        Properties of the extension.
    """
    app.connect("build-finished", write_markdown)
    return {"parallel_read_safe": True}
