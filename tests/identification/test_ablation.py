"""The ablation: every switch replaces what is there, and what it costs is told by pairs of logs."""

from __future__ import annotations

import pytest

from quadvel_sysid import candidates, fit
from tests.identification.ablation import SWITCHES, WHOLE, table, without


@pytest.mark.parametrize("switch", SWITCHES)
def test_a_switch_replaces_what_is_there_and_puts_it_back(switch: str) -> None:
    before = candidates.FITTED, fit._FAR_DELAY_CHANGES_S
    with without(switch):
        pass
    assert before == (candidates.FITTED, fit._FAR_DELAY_CHANGES_S)


def test_switches_joined_are_all_out() -> None:
    with without("half as many fits+far delays"):
        assert (candidates.FITTED, fit._FAR_DELAY_CHANGES_S) == (3, ())


def test_the_table_counts_what_is_told_otherwise() -> None:
    def row(verdict: str, after: float, seconds: float) -> dict[str, object]:
        return {"verdict": verdict, "named": [verdict], "after": after, "seconds": seconds}

    rows = {
        WHOLE: {"a": row("right", 1.0, 4.0), "b": row("right", 1.0, 4.0), "c": row("right", 1.0, 9.0)},
        "nesting": {"a": row("right", 1.21, 2.0), "b": row("wrong", 1.0, 2.0)},
    }
    last = table(rows).splitlines()[-1]
    assert last == "| nesting | 2 | 1 | 2 | 1 | 1.100 | 0.50 |"
