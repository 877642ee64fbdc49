"""The program `quadvel`: blocks SIGINT first, then loads and runs the commands of `cli`."""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Sequence
from typing import Any

from .error_sentence import exit_with_sentence

STOPPED = tuple(128 + number for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM))
"""Exit codes of a command that a signal ended."""
REPEAT_AFTER_S = 0.05
"""Time after which a Ctrl-C that was dropped is repeated."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line. Always ends with SystemExit.

    A wrong argument or file ends with one sentence and exit code 2, without a traceback; a signal
    with one sentence and exit code 128 + its number. SIGINT is blocked until the command is ready
    for it, and again after the command.

    Args:
        arguments: Arguments after `quadvel`; those of the process if None.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    from .cli import app

    warnings.showwarning, former = _show_warning, sys.unraisablehook
    sys.unraisablehook = _repeat_dropped_interrupt
    try:
        with exit_with_sentence("quadvel"):
            # Shell completion needs this name, however quadvel was started.
            app(arguments, prog_name="quadvel")
    except SystemExit as ended:
        if ended.code in STOPPED:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process ends now; ignore further Ctrl-C
            print("quadvel: stopped; no file was left half-written", file=sys.stderr)
        raise
    finally:
        sys.unraisablehook = former


def _repeat_dropped_interrupt(dropped: Any) -> None:
    """Repeat a Ctrl-C that Python dropped, as it does in the callback of a weak reference."""
    if issubclass(dropped.exc_type, KeyboardInterrupt):
        threading.Timer(REPEAT_AFTER_S, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(dropped)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning of a library in one line."""
    print(f"quadvel: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    main()
