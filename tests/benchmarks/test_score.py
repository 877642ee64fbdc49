"""Tests of the score: verdicts on synthetic reports, and an interrupted benchmark that continues."""

import json

import pytest

from benchmarks.identification import adapter, score, table
from benchmarks.identification.verdicts import score_report


def _entry(name, joints=("A_hip_joint",), others=(), **params):
    return {"name": name, "joints": list(joints), "params": params, "indistinguishable": list(others)}


def _report(*effects, verdict="white", depends_on=(), after=0.11):
    return {
        "effects": list(effects),
        "before": {"heldout_mse": 0.3},
        "after": {"heldout_mse": after},
        "noise_floor": 0.1,
        "unexplained": {"verdict": verdict, "depends_on": list(depends_on)},
        "decision": "",
    }


def _truth(group, *names, **more):
    effects = [
        {"name": name, "joints": ["A_hip_joint"], "params": {"c": 0.5}, "signals": {"key": ["q"]}, **more}
        for name in names
    ]
    return {
        "kind": names[0] if names else "none",
        "group": group,
        "motion": "mixed",
        "joints": ["A_hip_joint"],
    } | {
        "floor": 0.1,
        "effects": effects,
    }


@pytest.mark.parametrize(
    ("effects", "verdict"),
    [
        ((_entry("cogging"),), "right"),
        ((_entry("armature", others=["cogging", "deadband"]),), "right"),
        ((_entry("armature", others=["cogging", "a", "b", "c"]),), "wrong"),
        ((_entry("armature"), _entry("cogging")), "wrong"),
        ((), "missed"),
    ],
)
def test_one_effect_has_to_be_named_first_or_among_three_that_the_first_looks_like(effects, verdict):
    assert score_report(_report(*effects), _truth("alone", "cogging"))["verdict"] == verdict


@pytest.mark.parametrize(("fraction", "right"), [(0.09, True), (0.04, False)])
def test_lost_commands_are_scored_by_their_fraction_and_not_by_the_error(fraction, right):
    truth = _truth("alone", "command_hold", params={"share_of_samples": 0.1})
    report = _report(_entry("command_hold") | {"samples_hit": fraction}, after=0.3)
    assert score_report(report, truth)["within"] == right


def test_several_effects_have_all_to_be_named():
    truth = _truth("together", "cogging", "armature")
    assert score_report(_report(_entry("armature"), _entry("cogging")), truth)["verdict"] == "right"
    assert score_report(_report(_entry("armature")), truth)["verdict"] == "some"


def test_without_an_effect_anything_named_is_wrong():
    assert score_report(_report(), _truth("none"))["verdict"] == "right"
    assert score_report(_report(_entry("learned_residual")), _truth("none"))["verdict"] == "wrong"


def test_an_effect_outside_the_registry_needs_its_signal_and_most_of_its_error_removed():
    truth = _truth("outside", "rubbing_cable")
    found = {"verdict": "structured", "depends_on": ["q", "t"]}
    assert score_report(_report(**found), truth)["verdict"] == "right"
    assert score_report(_report(**found, after=0.25), truth)["verdict"] == "right, too little removed"
    assert score_report(_report(verdict="structured", depends_on=["dq"]), truth)["verdict"] == "wrong signal"
    assert score_report(_report(), truth)["verdict"] == "missed"


@pytest.mark.parametrize(("left", "right"), [(0.1, True), (0.13, False)])
def test_a_joint_may_be_left_out_where_an_effect_leaves_nothing(left, right):
    truth = _truth("alone", "cogging")
    truth["effects"][0]["joints"] = ["A_hip_joint", "B_hip_joint"]
    report = _report(_entry("cogging")) | {"joints": ["A_hip_joint", "B_hip_joint"]}
    report["after"]["per_joint"] = [0.1, left]
    assert score_report(report, truth)["right_joints"] == right


def test_an_interval_counts_in_the_units_that_the_report_gives():
    entry = _entry("cogging", c={"value": 520.0, "ci95": [480.0, 560.0], "unit": "mrad"})
    (interval,) = score_report(_report(entry), _truth("alone", "cogging"))["intervals"]
    assert interval["covered"]
    assert interval["value"] == pytest.approx(0.52)


def test_intervals_of_joints_are_scored_one_by_one():
    values = {"value": [0.5, 0.7], "ci95": [[0.45, 0.55], [0.65, 0.75]], "unit": "N m"}
    truth = _truth("alone", "cogging")
    truth["effects"][0]["params"] = {"c": 0.52}
    found = score_report(_report(_entry("cogging", c=values)), truth)["intervals"]
    assert [one["covered"] for one in found] == [True, False]


def test_what_the_tool_raises_is_a_verdict_and_the_table_shows_it(monkeypatch):
    def fail(logs, holdout, options):
        raise ValueError("broken")

    monkeypatch.setattr(adapter, "identify", fail)
    row = score.score_case("none", 1, 0)
    assert row["error"] == "ValueError: broken"
    assert "1 error: ValueError: broken" in table.markdown([row], 0)


def test_the_tool_sees_the_log_and_not_the_truth(monkeypatch):
    def check_folder(logs, holdout, options):
        (log,) = logs
        assert [path.name for path in log.parent.iterdir() if path.is_file()] == [log.name]
        assert "truth" not in str(log)
        return _report()

    monkeypatch.setattr(adapter, "identify", check_folder)
    assert "error" not in score.score_case("none", 1, 0)


def test_a_benchmark_continues_and_rejects_another_seed(tmp_path):
    (tmp_path / "cases").mkdir()
    row = {"kind": "none", "group": "none", "verdict": "right", "error": "x"}
    (tmp_path / "cases" / "none-000.json").write_text(json.dumps(row))
    assert score.run_campaign(["none"], 1, 3, 1, tmp_path) == [row]
    with pytest.raises(score.typer.BadParameter, match="seed: found 3, expected 4"):
        score.run_campaign(["none"], 1, 4, 1, tmp_path)


@pytest.mark.parametrize("kind", ["none", "load_dependent_friction"])
def test_the_identification_names_what_is_there_and_nothing_else(kind):
    row = score.score_case(kind, 0, 0)
    assert row.get("error") is None
    assert row["verdict"] == "right"
    assert row["extra"] == []
    assert row["within"]
