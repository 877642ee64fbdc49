"""The program `quadvel`, which is ready for Ctrl-C before it loads anything. Its commands are in `cli`."""

from __future__ import annotations

import os
import signal
import sys


def main() -> None:
    """A wrong argument or file ends in one sentence and exit code 2, without a traceback.

    SIGINT waits until the command allows it, and again once the command is done with it: Ctrl-C may come at
    any moment, and again.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    from .cli import app

    try:
        app(prog_name="quadvel")  # however it was started: shell completion goes by this name
    except (OSError, ValueError, MemoryError) as error:
        if os.environ.get("QUADVEL_TRACEBACK"):
            raise
        short = "this machine has too little memory for it: " if isinstance(error, MemoryError) else ""
        print(f"quadvel: {short}{error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
