"""The table of transitions, its diagram, and the latched stop."""

from __future__ import annotations

from pathlib import Path

import pytest

from quadvel_policy.guard import Finding, Level
from quadvel_policy.stop_latch import StopLatch
from quadvel_policy.transitions import AUTOMATIC, MODES, REQUESTED, state_diagram

HOT = Finding("motor_hot", Level.STANCE, ("walk",), "FR_calf_joint is hot")


def test_the_state_diagram_of_the_documentation_is_what_the_table_prints() -> None:
    page = (Path(__file__).parents[2] / "docs" / "architecture.md").read_text()
    assert f"```mermaid\n{state_diagram()}\n```" in page, "run: python -m quadvel_policy.transitions"


@pytest.mark.parametrize("table", [REQUESTED, AUTOMATIC])
def test_transitions_connect_modes_and_leave_a_fault_only_for_passive(
    table: dict[tuple[str, str], object],
) -> None:
    assert all(source in MODES and target in MODES for source, target in table)
    assert not any(source == "fault" for source, _ in table)
    assert not any(target in ("passive", "fault") for _, target in REQUESTED)


def test_a_latch_is_closed_until_it_is_opened() -> None:
    latch = StopLatch()
    assert (latch.sentence, latch.persists([HOT])) == ("", False)
    latch.close(HOT, 3.0)
    assert (latch.cause, latch.since, latch.sentence) == (HOT, 3.0, HOT.sentence)
    assert latch.persists([HOT])
    assert not latch.persists([])
    latch.open()
    assert (latch.cause, latch.persists([HOT])) == (None, False)
