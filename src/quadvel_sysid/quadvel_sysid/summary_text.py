"""What a report comes to, in a sentence or two."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from quadvel_actuator.effects.terms import LEARNED_RESIDUAL as TERMS

from .criterion import SIGNIFICANCE_LEVEL

UNTRACED = "it goes with no signal of the log, whose cause may be too rare in what is fitted"
"""Of what a model leaves that is not white"""
_LESS = 0.9
"""Of the error before, from which gains and delays of each joint are worth a word."""

_ELSEWHERE = 1.5
"""Times what the fitted data leave, or their noise: held-out data that leave more show what these do not."""


def decision(report: Mapping[str, Any]) -> str:
    """What to add to the model, and what that does to the held-out error."""
    text = _added(report) if report["effects"] else _nothing_added(report)
    return text + _shown_by_held_out_data_alone(report)


def _nothing_added(report: Mapping[str, Any]) -> str:
    before, after = report["before"]["heldout_mse"], report["after"]["heldout_mse"]
    rest = report["unexplained"]
    if rest["verdict"] != "white":
        signals = ", ".join(rest["depends_on"])
        why = f"it depends on {signals}" if signals else UNTRACED
        return f"No effect is added, but what the EAM leaves ({before:.3g} N^2 m^2) is not white: {why}."
    floor = f"(noise floor {report['noise_floor']:.3g}), and no effect is added."
    if after < _LESS * before:
        return (
            f"Nothing significant beside gains and delays of each joint: with them the EAM explains the torque to {after:.3g} "
            f"N^2 m^2, with one for all to {before:.3g} {floor}"
        )
    return f"Nothing significant: the plain EAM explains the torque to {before:.3g} N^2 m^2 {floor}"


def _added(report: Mapping[str, Any]) -> str:
    before, after = report["before"]["heldout_mse"], report["after"]["heldout_mse"]
    effects, rest = report["effects"], report["unexplained"]
    shown = [one for one in effects if one["p_value"] <= SIGNIFICANCE_LEVEL]
    named = ", ".join(dict.fromkeys(one["name"] for one in shown or effects))
    cut = 100.0 * (1.0 - after / before) if before > 0.0 else 0.0
    way = f"{'falls' if cut >= 0.0 else 'rises'} by {abs(cut):.0f} %"
    text = f"Add {named}: the held-out error {way}, from {before:.3g} to {after:.3g} N^2 m^2"
    learned = any(one["name"] == TERMS for one in effects)
    beyond = "what was learned beyond them" if learned else "what is left"
    more = f"; {beyond} depends on {', '.join(rest['depends_on'])}" if rest["depends_on"] else ""
    for one in effects:
        if shown and one not in shown:
            more += f"; {one['name']} is in the model, too, but the rows that are reported do not confirm it"
        if "samples_hit" in one:
            more += (
                f"; {one['name']} hits {100.0 * one['samples_hit']:.2g} % of the samples at random, which the error after "
                "holds, as no model foretells them"
            )
    return f"{text} (noise floor {report['noise_floor']:.3g}){more}."


def _shown_by_held_out_data_alone(report: Mapping[str, Any]) -> str:
    """A second sentence where the held-out data leave far more than the fitted ones, whose effects nothing can be fitted to."""
    fitted, after = report["after"]["train_mse"], report["after"]["heldout_mse"]
    if after < _ELSEWHERE * max(fitted, report["noise_floor"]):
        return ""
    return (
        f" The held-out data leave {after:.3g} N^2 m^2 where the fitted ones leave {fitted:.3g}: they show what these hardly "
        "do, and nothing can be fitted to it. Give logs that show it to fit to, too."
    )
