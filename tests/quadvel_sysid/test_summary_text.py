"""Summary sentences of a report."""

from __future__ import annotations

from typing import Any

from quadvel_sysid.report.summary_text import summary_text


def report(*effects: tuple[str, float]) -> dict[str, Any]:
    return {
        "before": {"heldout_mse": 1.0},
        "after": {"heldout_mse": 0.25, "train_mse": 0.25},
        "effects": [{"name": name, "p_value": p} for name, p in effects],
        "unexplained": {"verdict": "white", "depends_on": []},
        "noise_floor": 0.2,
    }


def test_significant_effects_are_added() -> None:
    text = summary_text(report(("armature", 1e-9), ("first_order_lag", 1e-3)))
    assert text == (
        "Add armature, first_order_lag: the held-out error falls by 75 %, from 1 to 0.25 N^2 m^2 (noise floor 0.2)."
    )


def test_an_effect_that_the_reported_rows_do_not_confirm_is_stated_separately() -> None:
    text = summary_text(report(("armature", 1e-9), ("supply_sag", 1.0)))
    assert text.startswith("Add armature: the held-out error falls by 75 %")
    assert "the model contains supply_sag as well, but the reported rows do not confirm it" in text


def test_without_a_confirmed_effect_the_selected_effects_are_stated() -> None:
    assert summary_text(report(("armature", 0.3))).startswith("Add armature:")
