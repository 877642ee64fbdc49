"""Links of a page that lead out of docs/ go to the repository on the web, at the version of the site."""

from __future__ import annotations

import os
import posixpath
import re
from pathlib import PurePosixPath
from typing import Any

from sphinx.application import Sphinx

LINK = re.compile(r"(?<!!)\]\((\.\./[^)\s]*)\)")
BRANCH = os.environ.get("GITHUB_REF_NAME", "main")
"""Branch or tag that is built; links lead to its files."""


def to_repository(app: Sphinx, page: str, source: list[str]) -> None:
    """Replace relative links that lead out of docs/.

    Args:
        app: The build.
        page: Name of the page, such as `tutorials/walk`.
        source: Its text, the only element; replaced.
    """
    folder = PurePosixPath("docs", page).parent
    repository = app.config.html_theme_options["github_url"]

    def replace(link: re.Match[str]) -> str:
        target = posixpath.normpath(str(folder / link[1]))
        return link[0] if target.startswith("docs/") else f"]({repository}/blob/{BRANCH}/{target})"

    source[0] = LINK.sub(replace, source[0])


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect to the build.

    Args:
        app: The build.

    Returns:
        Properties of the extension.
    """
    app.connect("source-read", to_repository)
    return {"parallel_read_safe": True}
