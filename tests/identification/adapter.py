"""The one place where the score touches the tool: files in, report.json's dict out."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def identify(logs: list[Path], holdout: list[Path]) -> dict[str, Any]:
    """The report on NPZ files, as `quadvel identify LOG... [--holdout LOG...]` makes it."""
    from quadvel_sysid.identify import identify as run
    from quadvel_sysid.logs.read_log import read_log

    return run([read_log(path) for path in logs], [read_log(path) for path in holdout]).report
