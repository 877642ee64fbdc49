"""Tests of the ablation study: switches replace existing names, and the comparison is paired."""

from __future__ import annotations

import attrs

from benchmarks.identification.ablation import BASELINE, SWITCHES, options_without, table
from quadvel_sysid.options import SEARCH_DEFAULTS, SearchOptions


def test_every_option_has_a_switch_that_turns_it_off() -> None:
    assert options_without(BASELINE) == SEARCH_DEFAULTS
    assert all(options_without(switch) != SEARCH_DEFAULTS for switch in SWITCHES if switch != BASELINE)
    assert {name for fields in SWITCHES.values() for name in fields} == {
        field.name for field in attrs.fields(SearchOptions)
    }


def test_joined_switches_turn_all_their_options_off() -> None:
    options = options_without("half as many fits+far delays")
    assert (options.fitted_effects, options.far_delays) == (3, False)


def test_the_table_counts_changed_verdicts() -> None:
    def row(verdict: str, after: float, seconds: float) -> dict[str, object]:
        return {"verdict": verdict, "named": [verdict], "after": after, "seconds": seconds}

    rows = {
        BASELINE: {"a": row("right", 1.0, 4.0), "b": row("right", 1.0, 4.0), "c": row("right", 1.0, 9.0)},
        "nesting": {"a": row("right", 1.21, 2.0), "b": row("wrong", 1.0, 2.0)},
    }
    last = table(rows).splitlines()[-1]
    assert last == "| nesting | 2 | 1 | 2 | 1 | 1.100 | 0.50 |"
