"""Cells that begin with `%%bash` are shown as commands, without this line."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

MAGIC = "%%bash\n"


def show_commands(app: Sphinx, doctree: nodes.document) -> None:
    """Remove the line `%%bash` of each cell, and colour the rest as a shell's.

    Args:
        app: The build.
        doctree: A page; changed.
    """
    for block in doctree.findall(nodes.literal_block):
        if block.astext().startswith(MAGIC):
            text = block.astext().removeprefix(MAGIC)
            block.rawsource = text
            block.children = [nodes.Text(text)]
            block["language"] = "bash"


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect to the build.

    Args:
        app: The build.

    Returns:
        Properties of the extension.
    """
    app.connect("doctree-read", show_commands)
    return {"parallel_read_safe": True}
