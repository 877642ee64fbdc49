"""URDF of the AlienGo for RViz, Foxglove, MoveIt, as a file. `urdf_generator` writes it."""

from __future__ import annotations

from pathlib import Path

FILE = Path(__file__).parent / "robots" / "aliengo.urdf"


def urdf() -> str:
    """Read the URDF: root link `base_link` with the trunk; joints as in `robot.JOINT_NAMES`.

    Returns:
        URDF text.
    """
    return FILE.read_text(encoding="utf-8")
