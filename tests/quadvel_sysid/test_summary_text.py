"""Summary sentences of a report."""

from __future__ import annotations

from typing import Any

from quadvel_sysid.report.summary_text import (
    inseparable_warnings,
    leave_one_out,
    leave_one_out_text,
    summary_text,
    withheld_summary,
)
from quadvel_sysid.statistics.confidence import InseparablePair


def report(*effects: tuple[str, float]) -> dict[str, Any]:
    return {
        "before": {"heldout_mse": 1.0},
        "after": {"heldout_mse": 0.25, "train_mse": 0.25},
        "effects": [{"name": name, "p_value": p, "at_bound": False} for name, p in effects],
        "effects_alone": None,
        "unexplained": {"verdict": "white", "depends_on": [], "edges": {"rows": 0.05, "error": 0.1}},
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


def test_without_a_confirmed_effect_none_is_added() -> None:
    text = summary_text(report(("armature", 0.3)))
    assert text.startswith("No effect is confirmed: with armature the held-out error falls, from 1 to 0.25")


def test_effects_that_raise_the_held_out_error_are_not_added() -> None:
    worse = report(("armature", 1e-9)) | {"before": {"heldout_mse": 0.2}}
    assert summary_text(worse).startswith("No effect is confirmed: with armature the held-out error does not")


def test_an_effect_whose_value_is_at_a_bound_is_not_added() -> None:
    found = report(("armature", 1e-9), ("soft_stop", 1e-9))
    found["effects"][1]["at_bound"] = True
    text = summary_text(found)
    assert text.startswith("Add armature:")
    assert "the model contains soft_stop as well, but a value of it is at a bound" in text


def test_named_effects_that_learned_terms_replaced_are_stated() -> None:
    found = report(("learned_residual", 1e-9))
    found["effects_alone"] = {"names": ["armature", "first_order_lag"], "heldout_mse": 0.3}
    assert "without learned terms, armature, first_order_lag leave 0.3 N^2 m^2" in summary_text(found)


def test_errors_after_changes_of_commands_are_mentioned() -> None:
    found = report(("armature", 1e-9))
    found["unexplained"]["edges"]["error"] = 0.79
    text = summary_text(found)
    assert "79 % of the remaining error is in the 5 % of the rows where a command has just changed" in text


def test_reasons_against_a_result_replace_its_decision() -> None:
    found = {"decision": "Add armature.", "warnings": ["a"]}
    assert withheld_summary(found, [], []) == {"withheld": [], **found}
    implausible = withheld_summary(found, ["kp is 0"], ["a filter is better"])
    assert implausible["decision"] == "Not a PD-controlled joint as logged: kp is 0; a filter is better."
    assert implausible["warnings"] == ["a", "kp is 0", "a filter is better"]
    assert withheld_summary(found, [], ["a filter is better"])["decision"].startswith("No decision:")


def test_logs_that_are_left_out_in_turn_show_what_their_models_share() -> None:
    values = {"delta_kp": 0.0, "delta_kd": 0.0, "input_delay_ms": 5.0, "output_delay_ms": 0.0}
    folds = []
    for name, error, effects, alone in (
        ("a", 0.2, ["learned_residual"], {"names": ["armature"], "heldout_mse": 0.3}),
        ("b", 0.4, ["armature", "cogging"], None),
    ):
        folds.append(
            {
                "before": {"heldout_mse": 1.0},
                "after": {"heldout_mse": error, **values},
                "baselines": {"ridge": {"heldout_mse": 0.5}},
                "effects": [{"name": one} for one in effects],
                "effects_alone": alone,
                "clocks": [
                    {"log": "other", "command_offset_ms": 0.0},
                    {"log": name, "command_offset_ms": 0.4},
                ],
            }
        )
    entry = leave_one_out(folds)
    assert [(one["log"], one["after"], one["command_offset_ms"]) for one in entry["logs"]] == [
        ("a", 0.2, 0.4),
        ("b", 0.4, 0.4),
    ]
    text = leave_one_out_text(entry)
    assert "error 1 before, 0.3 after" in text
    assert text.endswith("effects of all fits: armature; of some: learned_residual, cogging")


def test_parameters_that_no_log_separates_are_named_once_in_groups() -> None:
    pairs = [(("kp", "kd"), 0.96), (("c", "d"), 0.999), (("kd", "lag"), -0.97), (("lag", "kp"), -0.99)]
    first, second = inseparable_warnings([InseparablePair(names, 0, size) for names, size in pairs])
    assert first.startswith("c and d are not separable")
    assert second.startswith("kp, kd and lag are not separable")
    assert "if kp were known, the interval of lag would be 0.14 times as wide" in second
