"""The program `quadvel`, which is ready for Ctrl-C before it loads anything. Its commands are in `cli`."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Sequence

STOPPED = tuple(128 + number for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM))
"""Exit codes of a command that a signal ended"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line. Always ends with SystemExit.

    A wrong argument or file ends in one sentence and exit code 2, without a traceback; a signal in one sentence
    and exit code 128 + its number. SIGINT waits until the command allows it, and again once the command is done
    with it: Ctrl-C may come at any moment, and again.

    Args:
        arguments: what follows `quadvel`; those of the process if None.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    from .cli import app

    warnings.showwarning = _show_warning
    try:
        app(arguments, prog_name="quadvel")  # however it was started: shell completion goes by this name
    except (OSError, ValueError, MemoryError, RecursionError) as error:
        if os.environ.get("QUADVEL_TRACEBACK"):
            raise
        print(f"quadvel: {_sentence(error)}", file=sys.stderr)
        sys.exit(2)
    except SystemExit as ended:
        if ended.code in STOPPED:
            signal.signal(
                signal.SIGINT, signal.SIG_IGN
            )  # what follows is the end; another one changes nothing
            print("quadvel: stopped; no file was left half-written", file=sys.stderr)
        raise


def _sentence(error: Exception) -> str:
    """What is wrong. Of an error of the system the file and the reason, without its number."""
    if isinstance(error, MemoryError):
        return f"this machine has too little memory for it: {error}"
    if isinstance(error, RecursionError):
        return f"what was given is nested too deeply: {error}"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}"
    return " ".join(str(error).split())


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """A library's warning as one line, without its line of code."""
    print(f"quadvel: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    main()
