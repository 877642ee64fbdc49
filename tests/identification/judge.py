"""Judges one report.json against the truth of its case, by the table of the specification."""

from __future__ import annotations

from typing import Any

import numpy as np

Report = dict[str, Any]
Truth = dict[str, Any]

INDISTINGUISHABLE_MOST = 3
REMOVED_LEAST = 0.6
WITHIN = {"table 4": 1.05}
WITHIN_OTHERS = 1.15
SHARE_OFF, SHARE_LEAST = 0.25, 0.005
"""A share of samples may be off by so much of itself and so much more."""
SHOWS = 1.08
"""of the floor: a joint with less error than this hides nothing that could be found"""

# A true parameter by the names under which reports may give it, and the units in which they may do so.
ALIASES = {
    "limit": ("limit", "bound", "torque_limit", "tau_max"),
    "rate": ("rate", "slew_rate", "limit"),
    "T": ("T", "time_constant"),
    "delay": ("delay", "T", "lag"),
    "offset": ("offset", "c"),
    "amplitude": ("amplitude", "a", "A"),
    "asymmetry": ("asymmetry", "gain", "a"),
    "shift": ("shift", "skew", "delay"),
    "width": ("width", "w", "half_width"),
    "stall_torque": ("stall_torque", "stall"),
    "no_load_speed": ("no_load_speed", "no_load"),
}
UNITS = {"ms": 1e-3, "mrad": 1e-3, "kN m/s": 1e3, "%": 1e-2}


def judge(report: Report, truth: Truth) -> dict[str, Any]:
    """One row of the score: verdict, what was named, errors in N^2 m^2, intervals."""
    effects = report["effects"]
    true_names = [effect["name"] for effect in truth["effects"]]
    before, after = report["before"]["heldout_mse"], report["after"]["heldout_mse"]
    removable = before - truth["floor"]
    row = {
        "kind": truth["kind"],
        "group": truth["group"],
        "motion": truth["motion"],
        "joints": len(truth["joints"]),
        "effects": true_names,
        "named": [effect["name"] for effect in effects],
        "verdict": _VERDICTS[truth["group"]](report, truth),
        "extra": [e["name"] for e in effects if not any(_answers(e, true) for true in truth["effects"])],
        "right_joints": _right_joints(report, truth),
        "before": before,
        "after": after,
        "floor": truth["floor"],
        "floor_estimate": report["noise_floor"],
        "removed": (before - after) / removable if removable > 0 else 1.0,
        "within": _within(report, truth),
        "unexplained": report["unexplained"]["verdict"],
        "depends_on": report["unexplained"]["depends_on"],
        "all_signals": _all_signals(report, truth),
        "intervals": _intervals(effects, truth),
    }
    if truth["group"] == "outside" and row["verdict"] == "right" and row["removed"] < REMOVED_LEAST:
        row["verdict"] = "right, too little removed"
    return row


def _within(report: Report, truth: Truth) -> bool:
    """The error that is asked for; of an effect whose occurrences are random, the share of samples that it hit."""
    if truth["group"] == "alone" and "share_of_samples" in truth["effects"][0]["params"]:
        share = truth["effects"][0]["params"]["share_of_samples"]
        said = [entry["samples_hit"] for entry in report["effects"] if "samples_hit" in entry]
        return any(abs(one - share) <= SHARE_OFF * share + SHARE_LEAST for one in said)
    return report["after"]["heldout_mse"] <= WITHIN.get(truth["group"], WITHIN_OTHERS) * truth["floor"]


def _answers(entry: dict[str, Any], true: dict[str, Any]) -> bool:
    """An entry of the report names this effect, itself or as one of few that it cannot tell apart."""
    others = entry["indistinguishable"]
    names = {entry["name"], *(others if len(others) <= INDISTINGUISHABLE_MOST else ())}
    return not names.isdisjoint(true.get("accepted", [true["name"]]))


def _alone(report: Report, truth: Truth) -> str:
    if not report["effects"]:
        return "missed"
    return "right" if _answers(report["effects"][0], truth["effects"][0]) else "wrong"


def _together(report: Report, truth: Truth) -> str:
    found = [any(_answers(entry, true) for entry in report["effects"]) for true in truth["effects"]]
    return "right" if all(found) else "some" if any(found) else "wrong" if report["effects"] else "missed"


def _none(report: Report, truth: Truth) -> str:
    return "wrong" if report["effects"] else "right"


def _outside(report: Report, truth: Truth) -> str:
    unexplained = report["unexplained"]
    if unexplained["verdict"] != "structured":
        return "not structured" if report["effects"] else "missed"
    key = set(truth["effects"][0]["signals"]["key"])
    return "right" if key & set(unexplained["depends_on"]) else "wrong signal"


def _table_4(report: Report, truth: Truth) -> str:
    found = report["before"]
    wrong = [
        name
        for name, off in (
            ("delta_kp", abs(found["delta_kp"] / truth["delta_kp"] - 1) <= 0.05),
            ("delta_kd", abs(found["delta_kd"] / truth["delta_kd"] - 1) <= 0.20),
            ("input_delay_ms", abs(found["input_delay_ms"] - truth["input_delay_ms"]) <= 0.2),
            ("output_delay_ms", abs(found["output_delay_ms"] - truth["output_delay_ms"]) <= 0.2),
            ("effects", not report["effects"]),
        )
        if not off
    ]
    return f"wrong {', '.join(wrong)}" if wrong else "right"


_VERDICTS = {"alone": _alone, "together": _together, "none": _none, "outside": _outside, "table 4": _table_4}


def _all_signals(report: Report, truth: Truth) -> bool:
    """The report names a signal for each that takes part in an effect outside the registry."""
    named = set(report["unexplained"]["depends_on"])
    return all(named & set(names) for true in truth["effects"] for names in true["signals"].get("all", []))


def _right_joints(report: Report, truth: Truth) -> bool:
    """Every true effect is reported on joints of its own alone, and on all of those where without it something is left."""
    after = dict(zip(report.get("joints", ()), report["after"].get("per_joint", ()), strict=True))
    for true in truth["effects"]:
        on = {joint for entry in report["effects"] if _answers(entry, true) for joint in entry["joints"]}
        idle = {joint for joint, error in after.items() if error <= SHOWS * truth["floor"]}
        if not (on and on <= set(true["joints"]) <= on | idle):
            return False
    return True


def _intervals(effects: list[dict[str, Any]], truth: Truth) -> list[dict[str, Any]]:
    """The 95 % intervals of rightly named effects' parameters, of all joints or of each, beside the truth."""
    found = []
    for true in truth["effects"]:
        for entry in effects:
            if entry["name"] != true["name"] or not set(entry["joints"]) <= set(true["joints"]):
                continue
            for name, value in true["params"].items():
                given = next(
                    (entry["params"][a] for a in ALIASES.get(name, (name,)) if a in entry["params"]), None
                )
                if given is not None and given.get("ci95"):
                    unit = UNITS.get(given.get("unit", ""), 1.0)
                    values, edges = np.atleast_1d(given["value"]), np.atleast_2d(given["ci95"])
                    for number, (low, high) in zip(unit * values, unit * edges, strict=True):
                        found.append(
                            {
                                "effect": true["name"],
                                "param": name,
                                "truth": value,
                                "value": float(number),
                                "low": float(low),
                                "high": float(high),
                                "covered": bool(low <= value <= high),
                            }
                        )
    return found
