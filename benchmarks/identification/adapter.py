"""Interface between the score and the identification: files in, the content of report.json out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from quadvel_sysid.options import DEFAULTS, IdentifyOptions


def identify(logs: list[Path], holdout: list[Path], options: IdentifyOptions = DEFAULTS) -> dict[str, Any]:
    """Identify logs as `quadvel identify LOG... [--holdout LOG...]` does.

    Args:
        logs: NPZ files to fit.
        holdout: NPZ files to report on; may be empty.
        options: Options of the identification.

    Returns:
        Content of report.json.
    """
    from quadvel_sysid.identify import identify as run
    from quadvel_sysid.logs.read_log import read_log

    return dict(run([read_log(path) for path in logs], [read_log(path) for path in holdout], options).report)
