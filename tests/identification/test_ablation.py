"""Tests of the ablation study: switches replace existing names, and the comparison is paired."""

from __future__ import annotations

import pytest

from quadvel_sysid.model.torque_model import fit
from quadvel_sysid.search import candidates
from tests.identification.ablation import BASELINE, SWITCHES, table, without


@pytest.mark.parametrize("switch", SWITCHES)
def test_a_switch_replaces_existing_names_and_restores_them(switch: str) -> None:
    before = candidates.MAX_FITTED_LAWS, fit._FAR_DELAY_CHANGES_S
    with without(switch):
        pass
    assert before == (candidates.MAX_FITTED_LAWS, fit._FAR_DELAY_CHANGES_S)


def test_joined_switches_disable_all_devices() -> None:
    with without("half as many fits+far delays"):
        assert (candidates.MAX_FITTED_LAWS, fit._FAR_DELAY_CHANGES_S) == (3, ())


def test_the_table_counts_changed_verdicts() -> None:
    def row(verdict: str, after: float, seconds: float) -> dict[str, object]:
        return {"verdict": verdict, "named": [verdict], "after": after, "seconds": seconds}

    rows = {
        BASELINE: {"a": row("right", 1.0, 4.0), "b": row("right", 1.0, 4.0), "c": row("right", 1.0, 9.0)},
        "nesting": {"a": row("right", 1.21, 2.0), "b": row("wrong", 1.0, 2.0)},
    }
    last = table(rows).splitlines()[-1]
    assert last == "| nesting | 2 | 1 | 2 | 1 | 1.100 | 0.50 |"
