"""What an entry of a benchmark was made with: the commit, versions of libraries, digests of files."""

from __future__ import annotations

import hashlib
import platform
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).parents[1]
DIGEST_LENGTH = 12  # hexadecimal digits of a SHA-256


def last_commit(*paths: str) -> str:
    """Return the last commit that touched some folders.

    Args:
        *paths: Folders or files relative to the root of the repository.

    Returns:
        Short hash, with `+` if the files differ from that commit.
    """
    outputs = [
        subprocess.run(
            ["git", *call, "--", *paths], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout
        for call in (("log", "-1", "--format=%h"), ("status", "--porcelain"))
    ]
    return outputs[0].strip() + ("+" if outputs[1] else "")


def library_versions(distributions: Sequence[str]) -> dict[str, str]:
    """Return the versions of Python and of installed distributions.

    Args:
        distributions: Their names.

    Returns:
        Versions by name; without those that are not installed.
    """
    versions = {"python": platform.python_version()}
    for name in distributions:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def digest(path: Path) -> str:
    """Return the first digits of the SHA-256 of a file.

    Args:
        path: The file.

    Returns:
        DIGEST_LENGTH hexadecimal digits.
    """
    return hashlib.sha256(path.read_bytes()).hexdigest()[:DIGEST_LENGTH]
