"""Summary of an identification report in one or two sentences.

Its input is report.json as a mapping; the numbers are computed in `outcome`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quadvel_actuator.effects.basis_regressors import LEARNED_RESIDUAL

from ..statistics.confidence import InseparablePair
from ..statistics.criterion import SIGNIFICANCE_LEVEL

UNCORRELATED_TEXT = "uncorrelated with every logged signal; the cause may be too rare in the training rows"
"""Statement about a structured residual without a correlated signal."""
_JOINT_GAINS_ERROR_RATIO = 0.9
"""Error ratio below which separate gains and delays of each joint are mentioned."""

NOT_PD_TEXT = "Not a PD-controlled joint as logged"
WITHDRAWN_TEXT = "No decision"
"""Begin of a decision that was withdrawn, for an implausible result and for one that is contradicted."""
_MIN_EDGE_ERROR_SHARE, _MAX_EDGE_ROW_SHARE = 0.5, 0.2
"""Share of the error, and of the rows, after changes of commands, from which the summary mentions it."""
_HELDOUT_ERROR_RATIO = 1.5
"""Ratio of held-out to fitted error above which the held-out data show a further effect."""


def summary_text(report: Mapping[str, Any]) -> str:
    """Summarise which effects to add, and how the held-out error changes.

    Args:
        report: Content of report.json, without `decision`.

    Returns:
        One or two sentences.
    """
    text = _effects_text(report) if report["effects"] else _no_effect_text(report)
    return text + _heldout_only_text(report)


def _no_effect_text(report: Mapping[str, Any]) -> str:
    """Summary of a report without effects."""
    before, after = report["before"]["heldout_mse"], report["after"]["heldout_mse"]
    rest = report["unexplained"]
    if rest["verdict"] != "white":
        signals = ", ".join(rest["depends_on"])
        why = f"it depends on {signals}" if signals else f"it is {UNCORRELATED_TEXT}"
        return f"No effect is added, but the residual of the EAM ({before:.3g} N^2 m^2) is not white: {why}."
    floor = f"(noise floor {report['noise_floor']:.3g}), and no effect is added."
    if after < _JOINT_GAINS_ERROR_RATIO * before:
        return (
            f"Nothing significant except gains and delays of each joint: with these the EAM explains the torque to {after:.3g} "
            f"N^2 m^2, with common ones to {before:.3g} {floor}"
        )
    return f"Nothing significant: the plain EAM explains the torque to {before:.3g} N^2 m^2 {floor}"


def _effects_text(report: Mapping[str, Any]) -> str:
    """Summary of a report with effects."""
    before, after = report["before"]["heldout_mse"], report["after"]["heldout_mse"]
    effects, rest = report["effects"], report["unexplained"]
    shown = [one for one in effects if one["p_value"] <= SIGNIFICANCE_LEVEL and not one["at_bound"]]
    change = f"from {before:.3g} to {after:.3g} N^2 m^2"
    if not shown or after >= before:
        tried = ", ".join(dict.fromkeys(one["name"] for one in effects))
        way = "falls" if after < before else "does not fall"
        text = f"No effect is confirmed: with {tried} the held-out error {way}, {change}"
    else:
        named = ", ".join(dict.fromkeys(one["name"] for one in shown))
        text = f"Add {named}: the held-out error falls by {100.0 * (1.0 - after / before):.0f} %, {change}"
    learned = any(one["name"] == LEARNED_RESIDUAL for one in effects)
    beyond = "the learned remainder" if learned else "the residual"
    more = f"; {beyond} depends on {', '.join(rest['depends_on'])}" if rest["depends_on"] else ""
    alone = report["effects_alone"]
    if alone and alone["names"]:
        more += (
            f"; without learned terms, {', '.join(alone['names'])} leave {alone['heldout_mse']:.3g} N^2 m^2"
        )
    edges = rest["edges"]
    if edges["error"] >= _MIN_EDGE_ERROR_SHARE and edges["rows"] <= _MAX_EDGE_ROW_SHARE:
        more += (
            f"; {100.0 * edges['error']:.0f} % of the remaining error is in the {100.0 * edges['rows']:.0f} % of the "
            "rows where a command has just changed"
        )
    for one in effects:
        if shown and one not in shown:
            why = "a value of it is at a bound" if one["at_bound"] else "the reported rows do not confirm it"
            more += f"; the model contains {one['name']} as well, but {why}"
        if "samples_hit" in one:
            more += (
                f"; {one['name']} affects {100.0 * one['samples_hit']:.2g} % of the samples at random, which no model "
                "can predict, so that the error after the correction contains them"
            )
    return f"{text} (noise floor {report['noise_floor']:.3g}){more}."


def _heldout_only_text(report: Mapping[str, Any]) -> str:
    """Second sentence for held-out data with an effect that the fitted data lack."""
    fitted, after = report["after"]["train_mse"], report["after"]["heldout_mse"]
    if after < _HELDOUT_ERROR_RATIO * max(fitted, report["noise_floor"]):
        return ""
    return (
        f" The held-out error is {after:.3g} N^2 m^2, the error of the fitted data {fitted:.3g}: the held-out data contain an "
        "effect that the fitted data hardly show. Add logs that show it to the fitted ones."
    )


def withheld_summary(
    report: Mapping[str, Any], implausible: Sequence[str], contradicted: Sequence[str]
) -> dict[str, Any]:
    """Build the entries of a report whose decision may have to be withdrawn.

    Args:
        report: Content of report.json.
        implausible: Reasons why the result is not that of a PD-controlled joint.
        contradicted: Reasons why the named effects do not describe the joints.

    Returns:
        The entries `withheld` (the reasons, none if the model can be used), `decision` and `warnings`.
    """
    reasons = [*implausible, *contradicted]
    decision = report["decision"]
    if reasons:
        title = NOT_PD_TEXT if implausible else WITHDRAWN_TEXT
        decision = f"{title}: {'; '.join(reasons)}."
    return {"withheld": reasons, "decision": decision, "warnings": [*report["warnings"], *reasons]}


def leave_one_out(reports: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Build the entry of a report on fits that each leave one log out.

    Args:
        reports: Content of report.json of each fit, which reports on the log that was left out.

    Returns:
        `before` and `after` (mean held-out errors, N^2 m^2), `shared` (effects that all fits found,
        in the corrected model or in the best one without learned terms), `differing` (effects that
        some found), and `logs`: for each log its errors, its clock, and the model of the other logs.
    """
    named = [dict.fromkeys(one["name"] for one in report["effects"]) for report in reports]
    found = [
        {**each, **dict.fromkeys((report["effects_alone"] or {"names": ()})["names"])}
        for each, report in zip(named, reports, strict=True)
    ]
    every = dict.fromkeys(name for names in found for name in names)
    shared = [name for name in every if all(name in each for each in found)]
    values = ("delta_kp", "delta_kd", "input_delay_ms", "output_delay_ms")
    return {
        **{
            name: sum(report[name]["heldout_mse"] for report in reports) / len(reports)
            for name in ("before", "after")
        },
        "shared": shared,
        "differing": [name for name in every if name not in shared],
        "logs": [
            {
                "log": report["clocks"][-1]["log"],
                "before": report["before"]["heldout_mse"],
                "after": report["after"]["heldout_mse"],
                "ridge": report["baselines"]["ridge"]["heldout_mse"],
                "command_offset_ms": report["clocks"][-1]["command_offset_ms"],
                "effects": list(names),
                **{name: report["after"][name] for name in values},
            }
            for report, names in zip(reports, named, strict=True)
        ],
    }


def leave_one_out_text(entry: Mapping[str, Any]) -> str:
    """Summarise fits that each leave one log out, in one line.

    Args:
        entry: `leave_one_out` of report.json.

    Returns:
        One sentence.
    """
    shared, differing = (", ".join(entry[name]) or "none" for name in ("shared", "differing"))
    return (
        f"each log left out in turn: error {entry['before']:.3g} before, {entry['after']:.3g} after, N^2 m^2; "
        f"effects of all fits: {shared}; of some: {differing}"
    )


def motion_summary(report: Mapping[str, Any]) -> dict[str, Any]:
    """Build the entries of a report that differ where the torque was inferred from the motion.

    Args:
        report: Content of report.json with the section `motion`.

    Returns:
        The entries `before`, `after` and `decision`.
    """
    motion = report["motion"]
    before, after = motion["before"], motion["after"]
    decision = (
        f"From motion alone. {report['decision']} In replays over {1e3 * motion['replayed_s']:.0f} ms the error of q changes "
        f"from {before['q_rms_rad']:.3g} to {after['q_rms_rad']:.3g} rad."
    )
    return {
        "before": report["before"] | {f"heldout_{name}": value for name, value in before.items()},
        "after": report["after"] | {f"heldout_{name}": value for name, value in after.items()},
        "decision": decision,
    }


def inseparable_warnings(pairs: Sequence[InseparablePair]) -> list[str]:
    """Warnings about parameters of which only combinations are known, one for each connected group.

    Args:
        pairs: Pairs of parameters that the logs do not separate.

    Returns:
        A sentence for each group, with its worst pair.
    """
    groups: list[set[str]] = []
    for pair in pairs:
        joined = [group for group in groups if group & set(pair.names)]
        groups = [group for group in groups if group not in joined]
        groups.append(set(pair.names).union(*joined))
    found = []
    for group in groups:
        inside = [pair for pair in pairs if pair.names[0] in group]
        *others, last = dict.fromkeys(name for pair in inside for name in pair.names)
        worst = min(inside, key=lambda pair: pair.conditional)
        found.append(
            f"{', '.join(others)} and {last} are not separable in these logs: if {worst.names[1]} were known, the "
            f"interval of {worst.names[0]} would be {worst.conditional:.2f} times as wide"
        )
    return found
