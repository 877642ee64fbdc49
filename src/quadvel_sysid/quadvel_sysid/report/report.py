"""Writes what an identification found: report.html for people, report.json for programs, actuator.yaml for the stack.

All three or none: they are complete beside their places before the first of them takes its own.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from ..identification import Identification
from .page import page

FILES = ("report.html", "report.json", "actuator.yaml")


def write(identification: Identification, out: Path) -> None:
    """Write FILES to the folder `out`, which is made if need be; other files in it stay.

    Raises ValueError where a number of the report is not finite, OSError where the folder cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out, prefix=".report-") as folder:
        drafts = Path(folder)
        content = json.dumps(identification.report, indent=1, allow_nan=False)
        (drafts / "report.json").write_text(content + "\n")
        identification.parameters.save(drafts / "actuator.yaml")
        (drafts / "report.html").write_text(page(identification), encoding="utf-8")
        for name in FILES:
            (drafts / name).replace(out / name)
