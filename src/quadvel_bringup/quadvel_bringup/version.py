"""Version and commit of this quadvel."""

from __future__ import annotations

import subprocess
from importlib import metadata
from pathlib import Path


def version() -> str:
    """Return the version and, in a source tree, the commit.

    Returns:
        Such as "0.1.0 (commit 873baba)"; with local changes "0.1.0 (commit 873baba, changed)".
    """
    try:
        number = metadata.version("quadvel-core")
    except metadata.PackageNotFoundError:  # built by colcon, package by package
        number = metadata.version("quadvel_bringup")
    commit = _git("describe", "--always", "--exclude=*", "--dirty=, changed")
    return f"{number} (commit {commit})" if commit else number


def _git(*arguments: str) -> str:
    """Return the output of git for the source tree of this file, or "" outside of one."""
    here = Path(__file__).parent
    if (here.parents[2] / "src" / "quadvel_bringup" / "quadvel_bringup") != here:
        return ""  # installed; an enclosing repository is not that of quadvel
    try:
        answer = subprocess.run(["git", "-C", here, *arguments], capture_output=True, text=True)
    except OSError:
        return ""
    return answer.stdout.strip()
