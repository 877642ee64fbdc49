"""Summary of an identification report in one or two sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from quadvel_actuator.effects.basis_regressors import LEARNED_RESIDUAL

from ..statistics.criterion import SIGNIFICANCE_LEVEL

UNCORRELATED_TEXT = "uncorrelated with every logged signal; the cause may be too rare in the training rows"
"""Statement about a structured residual without a correlated signal."""
_JOINT_GAINS_ERROR_RATIO = 0.9
"""Error ratio below which separate gains and delays of each joint are mentioned."""

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
    shown = [one for one in effects if one["p_value"] <= SIGNIFICANCE_LEVEL]
    named = ", ".join(dict.fromkeys(one["name"] for one in shown or effects))
    cut = 100.0 * (1.0 - after / before) if before > 0.0 else 0.0
    way = f"{'falls' if cut >= 0.0 else 'rises'} by {abs(cut):.0f} %"
    text = f"Add {named}: the held-out error {way}, from {before:.3g} to {after:.3g} N^2 m^2"
    learned = any(one["name"] == LEARNED_RESIDUAL for one in effects)
    beyond = "the learned remainder" if learned else "the residual"
    more = f"; {beyond} depends on {', '.join(rest['depends_on'])}" if rest["depends_on"] else ""
    for one in effects:
        if shown and one not in shown:
            more += f"; the model contains {one['name']} as well, but the reported rows do not confirm it"
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
