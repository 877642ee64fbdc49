"""Which quadvel this is."""

from __future__ import annotations

import subprocess
from importlib import metadata
from pathlib import Path


def version() -> str:
    """Number and, in a source tree, commit: "0.1.0 (commit 873baba)"; with changes on top: "873baba, changed"."""
    try:
        number = metadata.version("quadvel")
    except metadata.PackageNotFoundError:  # built by colcon, package by package
        number = metadata.version("quadvel_bringup")
    commit = _git("describe", "--always", "--exclude=*", "--dirty=, changed")
    return f"{number} (commit {commit})" if commit else number


def _git(*arguments: str) -> str:
    """What git answers about the tree that this file belongs to, or "" where it belongs to none."""
    here = Path(__file__).parent
    if (here.parents[2] / "src" / "quadvel_bringup" / "quadvel_bringup") != here:
        return ""  # installed; a repository around it would be somebody else's
    try:
        answer = subprocess.run(["git", "-C", here, *arguments], capture_output=True, text=True)
    except OSError:
        return ""
    return answer.stdout.strip()
