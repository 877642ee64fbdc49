"""Settings of the site: `make docs` builds docs/ into out/docs."""

from __future__ import annotations

import os
import sys
import tomllib
from pathlib import Path
from typing import Any

import quadvel_dds

DOCS = Path(__file__).parent
ROOT = DOCS.parent
sys.path.insert(0, str(DOCS / "_ext"))
quadvel_dds.install()  # modules of nodes import rclpy and messages
# What the tutorials run: the commands of this environment, on a DDS domain of their own.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
os.environ["QUADVEL"] = str(ROOT)
os.environ["PYTHONSTARTUP"] = str(DOCS / "_ext" / "terminal.py")
os.environ.setdefault("ROS_DOMAIN_ID", "3")  # the demo has 0, tests have 4 and more

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
project = "quadvel"
author = "quadvel maintainers"
copyright = "quadvel maintainers, Apache-2.0"
release = version = PYPROJECT["version"]

extensions = [
    "myst_nb",
    "sphinx.ext.apidoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinxcontrib.mermaid",
    "code_reference",
    "markdown_pages",
    "repository_links",
    "terminal_cells",
]
exclude_patterns = ["_ext", "_static", "reference/api/*/modules.rst"]
suppress_warnings = ["ref.python"]  # an annotation that two modules define
default_role = "code"  # of docstrings, which name code in single backticks

# Pages: Markdown as GitHub shows it. Diagrams are fenced blocks; anchors of headings are GitHub's.
myst_enable_extensions = ["attrs_inline", "colon_fence", "dollarmath"]
myst_fence_as_directive = ["mermaid"]
myst_heading_anchors = 4

# Tutorials run while the site is built. An unchanged page is not run again: its results are cached in out.
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "out" / "docs-cache")
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 900  # of a cell, s: ten times what an idle machine needs
nb_merge_streams = True

# The Python interface: a folder for each package, because apidoc removes what it did not write.
PACKAGES = [path.parent for path in sorted(ROOT.glob("src/*/*/__init__.py"))] + [
    ROOT / "training/quadvel_training"
]
UNDOCUMENTED = (
    "src/quadvel_dds/quadvel_dds/rclpy*",  # the interface of rclpy, documented there
)
apidoc_modules = [
    {
        "path": str(package),
        "destination": f"reference/api/{package.name}",
        "exclude_patterns": [str(ROOT / path) for path in UNDOCUMENTED],
        "separate_modules": True,
        "module_first": True,
        "max_depth": 1,
        "automodule_options": {"members", "show-inheritance"},
    }
    for package in PACKAGES
]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_format = "short"
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "pydata_sphinx_theme"
html_title = "quadvel"
html_theme_options = {
    "github_url": PYPROJECT["urls"]["Repository"],
    "check_switcher": False,
    "switcher": {
        "json_url": "https://quadvel.github.io/quadvel/switcher.json",
        "version_match": os.environ.get("GITHUB_REF_NAME", "main"),
    },
    "navbar_end": ["version-switcher", "theme-switcher", "navbar-icon-links"],
    "show_toc_level": 2,
    # Tutorials have none: their terminals need the width.
    "secondary_sidebar_items": {"[!t]**": ["page-toc"]},
    "footer_start": ["copyright"],
    "footer_end": [],
    "navigation_with_keys": False,
}
html_static_path = ["_static", str(ROOT / "out" / "mermaid")]
# `make docs` fetches what draws the diagrams, and the site serves it.
mermaid_use_local = "dist/mermaid.esm.min.mjs"
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
copybutton_exclude = ".linenos, .gp, .go"


def setup(app: Any) -> None:
    """Read docstrings as the plain text that they are.

    Args:
        app: The build.
    """
    app.connect("autodoc-process-docstring", keep_text)
    app.connect("env-before-read-docs", read_tutorials_first)


def read_tutorials_first(app: Any, env: Any, pages: list[str]) -> None:
    """Let one process run the tutorials, which takes longest, while the others read the rest.

    Args:
        app: The build.
        env: Its environment.
        pages: Names of the pages in the order in which they are read; changed.
    """
    pages.sort(key=lambda page: not page.startswith("tutorials/"))


def keep_text(app: Any, what: str, name: str, subject: Any, options: Any, lines: list[str]) -> None:
    """Keep bars of absolute values, and the lines that follow Typer's control character up to the next empty one.

    Args:
        app: The build.
        what: Kind of what is documented.
        name: Its name.
        subject: What is documented.
        options: Options of the directive.
        lines: Its docstring; changed.
    """
    kept = False
    for number, line in enumerate(lines):
        if line.strip() in ("\b", ""):
            kept = line.strip() == "\b"
            lines[number] = ""
        else:
            lines[number] = ("| " if kept else "") + line.replace("|", r"\|")
