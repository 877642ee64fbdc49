"""Write report.html, report.json and actuator.yaml.

The files are written to a temporary folder and then moved, so that a failure leaves no partial
report.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from .identification import Identification
from .page import report_page

REPORT_FILES = ("report.html", "report.json", "actuator.yaml")
"""Names of the files of a report."""


def write_report(identification: Identification, out: Path, force: bool = False) -> tuple[str, ...]:
    """Write the files of a report; a model that is withheld is not written.

    Args:
        identification: The result to write.
        out: Folder; created if it does not exist. Other files in it are kept, except for the
            actuator.yaml of an earlier report.
        force: Write actuator.yaml even if the model is withheld.

    Returns:
        Names of the files that were written.

    Raises:
        ValueError: If a number of the report is not finite.
        OSError: If the folder cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out, prefix=".report-") as folder:
        drafts = Path(folder)
        content = json.dumps(identification.report, indent=1, allow_nan=False)
        (drafts / "report.json").write_text(content + "\n")
        identification.parameters.save(drafts / "actuator.yaml")
        (drafts / "report.html").write_text(report_page(identification), encoding="utf-8")
        names = REPORT_FILES if force or not identification.report["withheld"] else REPORT_FILES[:-1]
        for name in names:
            (drafts / name).replace(out / name)
        for name in set(REPORT_FILES) - set(names):
            (out / name).unlink(missing_ok=True)
    return names
