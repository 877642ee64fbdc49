"""Compares one report.json with the ground truth of its log."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

Report = dict[str, Any]
Truth = dict[str, Any]

MAX_INDISTINGUISHABLE = 3
"""Maximum number of indistinguishable laws for which naming the truth among them counts."""
MIN_REMOVED_FRACTION = 0.6
ERROR_RATIO_LIMITS = {"table 4": 1.05}
DEFAULT_ERROR_RATIO_LIMIT = 1.15
SAMPLES_HIT_RELATIVE_TOLERANCE, SAMPLES_HIT_TOLERANCE = 0.25, 0.005
"""Relative and absolute tolerance of the fraction of samples that an effect affects."""
VISIBLE_ERROR_RATIO = 1.08
"""Ratio of a joint's error to the noise floor below which nothing is left to be found."""

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


def score_report(report: Report, truth: Truth) -> dict[str, Any]:
    """Score one report.

    Args:
        report: Content of report.json.
        truth: Ground truth from the generator.

    Returns:
        One row of the score: verdict, named effects, errors (N^2 m^2), intervals.
    """
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
        "verdict": naming_verdict(report, truth),
        "extra": [e["name"] for e in effects if not any(_names_effect(e, true) for true in truth["effects"])],
        "right_joints": named_joints_are_right(report, truth),
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
    if truth["group"] == "outside" and row["verdict"] == "right" and row["removed"] < MIN_REMOVED_FRACTION:
        row["verdict"] = "right, too little removed"
    return row


def _within(report: Report, truth: Truth) -> bool:
    """Whether the error, or the fraction of samples of a random effect, meets the target."""
    if truth["group"] == "alone" and "share_of_samples" in truth["effects"][0]["params"]:
        share = truth["effects"][0]["params"]["share_of_samples"]
        reported = [entry["samples_hit"] for entry in report["effects"] if "samples_hit" in entry]
        return any(
            abs(one - share) <= SAMPLES_HIT_RELATIVE_TOLERANCE * share + SAMPLES_HIT_TOLERANCE
            for one in reported
        )
    return (
        report["after"]["heldout_mse"]
        <= ERROR_RATIO_LIMITS.get(truth["group"], DEFAULT_ERROR_RATIO_LIMIT) * truth["floor"]
    )


def _names_effect(entry: dict[str, Any], true: dict[str, Any]) -> bool:
    """Whether an entry names this effect, itself or among a few indistinguishable ones."""
    others = entry["indistinguishable"]
    names = {entry["name"], *(others if len(others) <= MAX_INDISTINGUISHABLE else ())}
    return not names.isdisjoint(true.get("accepted", [true["name"]]))


def _alone(report: Report, truth: Truth) -> str:
    if not report["effects"]:
        return "missed"
    return "right" if _names_effect(report["effects"][0], truth["effects"][0]) else "wrong"


def _together(report: Report, truth: Truth) -> str:
    found = [any(_names_effect(entry, true) for entry in report["effects"]) for true in truth["effects"]]
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


def naming_verdict(report: Report, truth: Truth) -> str:
    """Compare the names in a report with those of the truth.

    Args:
        report: Content of report.json: `effects` and `unexplained`; for `table 4` also `before`.
        truth: Ground truth from the generator.

    Returns:
        `right`, or what is wrong.
    """
    return _VERDICTS[truth["group"]](report, truth)


def _all_signals(report: Report, truth: Truth) -> bool:
    """Whether the report names a signal of each part of an effect outside the registry."""
    named = set(report["unexplained"]["depends_on"])
    return all(named & set(names) for true in truth["effects"] for names in true["signals"].get("all", []))


def named_joints_are_right(report: Report, truth: Truth) -> bool:
    """Compare the joints of named effects with those of the truth.

    Args:
        report: Content of report.json: `effects` and `after`.
        truth: Ground truth from the generator.

    Returns:
        Whether every true effect is reported on its own joints, and on all where it is visible.
    """
    after = dict(zip(report.get("joints", ()), report["after"].get("per_joint", ()), strict=True))
    for true in truth["effects"]:
        on = {joint for entry in report["effects"] if _names_effect(entry, true) for joint in entry["joints"]}
        idle = {joint for joint, error in after.items() if error <= VISIBLE_ERROR_RATIO * truth["floor"]}
        if not (on and on <= set(true["joints"]) <= on | idle):
            return False
    return True


def parameter_errors(effects: list[dict[str, Any]], truth: Truth) -> list[float]:
    """Compare the parameters of correctly named effects with the true ones.

    Args:
        effects: Named effects of a report.
        truth: Ground truth from the generator.

    Returns:
        Relative error of each parameter, the mean over its joints if it has a value for each.
    """
    return [
        float(np.mean(np.abs(unit * np.atleast_1d(given["value"]) / value - 1.0)))
        for _, value, given, unit in _named_parameters(effects, truth)
        if value
    ]


def _named_parameters(
    effects: list[dict[str, Any]], truth: Truth
) -> Iterator[tuple[str, float, dict[str, Any], float]]:
    """Yield effect and parameter, true value, entry of the report and its unit in SI units."""
    for true in truth["effects"]:
        for entry in effects:
            if entry["name"] != true["name"] or not set(entry["joints"]) <= set(true["joints"]):
                continue
            for name, value in true["params"].items():
                for alias in ALIASES.get(name, (name,)):
                    if alias in entry["params"]:
                        given = entry["params"][alias]
                        yield f"{true['name']}/{name}", value, given, UNITS.get(given.get("unit", ""), 1.0)
                        break


def _intervals(effects: list[dict[str, Any]], truth: Truth) -> list[dict[str, Any]]:
    """The 95 % intervals of correctly named effects' parameters, next to the true values."""
    found = []
    for name, value, given, unit in _named_parameters(effects, truth):
        if not given.get("ci95"):
            continue
        values, edges = np.atleast_1d(given["value"]), np.atleast_2d(given["ci95"])
        for number, (low, high) in zip(unit * values, unit * edges, strict=True):
            found.append(
                {
                    "effect": name.partition("/")[0],
                    "param": name.partition("/")[2],
                    "truth": value,
                    "value": float(number),
                    "low": float(low),
                    "high": float(high),
                    "covered": bool(low <= value <= high),
                }
            )
    return found
