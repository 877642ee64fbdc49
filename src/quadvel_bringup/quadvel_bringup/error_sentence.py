"""Errors of a command line: one sentence instead of a traceback."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def exit_with_sentence(program: str) -> Iterator[None]:
    """End the process with one sentence and exit code 2 if an argument or a file is wrong.

    With QUADVEL_TRACEBACK=1 the error passes.

    Args:
        program: Name that the sentence starts with.

    Yields:
        Nothing.

    Raises:
        SystemExit: An argument or a file is wrong.
    """
    try:
        yield
    except (OSError, ValueError, MemoryError, RecursionError) as error:
        if os.environ.get("QUADVEL_TRACEBACK"):
            raise
        print(f"{program}: {_sentence(error)}", file=sys.stderr)
        sys.exit(2)


def _sentence(error: Exception) -> str:
    """Describe an error in one line; a system error by its file and reason."""
    if isinstance(error, MemoryError):
        return f"not enough memory on this machine: {error}"
    if isinstance(error, RecursionError):
        return f"the input is nested too deeply: {error}"
    if isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
        return "no space left on the disk of the output"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}"
    return " ".join(str(error).split())
