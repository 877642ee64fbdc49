"""HTML page of an identification report, self-contained in one file.

It displays the numbers of report.json and the figures, and computes no further results. The HTML is
in `templates/report.html.j2`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from quadvel_actuator.effects.basis_regressors import LEARNED_RESIDUAL

from ..excitation import propose
from . import figures
from .identification import Identification, Shape
from .rendering import number_text, render, short_joint_name
from .summary_text import UNCORRELATED_TEXT

_EAM = (
    ("delta_kp", "ΔKp", "N m/rad"),
    ("delta_kd", "ΔKd", "N m s/rad"),
    ("input_delay_ms", "input delay", "ms"),
    ("output_delay_ms", "output delay", "ms"),
    ("total_delay_ms", "sum of both delays", "ms"),
)
"""Gains and delays: key in report.json, title, unit."""


def report_page(identification: Identification) -> str:
    """Render the page of a report.

    Args:
        identification: The result to show.

    Returns:
        HTML text of the whole page.
    """
    report, traces = identification.report, identification.traces
    candidates = sorted(_candidates(report), key=lambda one: -one["gain"])
    bars = [[one[key] for one in candidates] for key in ("name", "gain", "selected")]
    return render(
        "report.html.j2",
        title="Identification of the actuators",
        decision=report["decision"],
        report=report,
        tiles=_tiles(report),
        joints=_joints(report),
        distribution=figures.distribution_figure(traces, report["noise_floor"] or 0.0) if traces else None,
        torques=_torques(identification),
        replayed=_replayed(report),
        shapes=_shape_figures(identification.shapes),
        candidates=candidates,
        candidate_figure=figures.candidate_figure(*bars) if candidates else None,
        parameters=[(name, rows) for name, rows in _parameters(report) if rows],
        learned=next((one for one in report["effects"] if one["name"] == LEARNED_RESIDUAL), None),
        uncorrelated=UNCORRELATED_TEXT,
        proposals=propose(report),
    )


def _tiles(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Key figures: errors, gains and delays."""
    before, after = report["before"], report["after"]
    unit = f"{report['units'].get('mse', 'N² m²')}, held out"
    reference = report["reference_gains"]
    if reference["commanded"]:
        ideal = [_error_tile(report["pd"], f"ideal PD, {unit}")]
        gains = (f"{before['delta_kp']:+.3g} / {before['delta_kd']:+.3g}", "ΔKp, ΔKd of the plain EAM")
    else:  # nothing was commanded that a PD law could have, or deviate from
        kp, kd = (reference[name] + before[f"delta_{name}"] for name in ("kp", "kd"))
        ideal, gains = [], (f"{kp:.3g} / {kd:.3g}", "Kp, Kd of the plain EAM; none is in the log")
    return [
        *ideal,
        _error_tile(before, f"plain EAM, {unit}"),
        _error_tile(report["baselines"]["joint_pd"], "a PD law of each joint"),
        _error_tile(report["baselines"]["ridge"], "a linear filter over 16 ms"),
        _error_tile(after, f"corrected model, {unit}"),
        (number_text(report["noise_floor"]), "noise floor, N² m²"),
        gains,
        (f"{before['input_delay_ms']:.2f} / {before['output_delay_ms']:.2f}", "its delays, ms, in and out"),
    ]


def _error_tile(entry: Mapping[str, Any], name: str) -> tuple[str, str]:
    """Tile of a held-out error and of the explained fraction of the torque's variance."""
    share = entry.get("heldout_explained")
    explained = "" if share is None else f"; explains {number_text(100.0 * share)} % of the torque's variance"
    return number_text(entry["heldout_mse"]), name + explained


def _joints(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Errors of each joint before and after, and the lengths of their bars, percent."""
    before, after = report["before"]["per_joint"], report["after"]["per_joint"]
    largest = max([value for value in (*before, *after) if value is not None], default=1.0) or 1.0
    return [
        {
            "joint": joint,
            "before": old,
            "after": new,
            "less": "–" if not old or new is None else f"{100 * (1 - new / old):.0f} %",
            "before_bar": 100 * (old or 0.0) / largest,
            "after_bar": 100 * (new or 0.0) / largest,
        }
        for joint, old, new in zip(report["joints"], before, after, strict=True)
    ]


def _torques(identification: Identification) -> list[dict[str, Any]]:
    """Torque figure of each joint; the one of the joint with the largest gain is open."""
    report, traces = identification.report, identification.traces
    gains = {
        joint: (old or 0.0) - (new or 0.0)
        for joint, old, new in zip(
            report["joints"], report["before"]["per_joint"], report["after"]["per_joint"], strict=True
        )
        if joint in traces
    }
    best = max(gains, key=lambda joint: gains[joint], default=None)
    return [
        {"joint": joint, "open": joint == best, "figure": figures.torque_figure(traces[joint])}
        for joint in gains
    ]


def _shape_figures(shapes: Sequence[Shape]) -> dict[str, list[str]]:
    """Residual figures by effect, three joints in a figure."""
    found: dict[str, list[str]] = {}
    for name in dict.fromkeys(shape.effect for shape in shapes):
        mine = [shape for shape in shapes if shape.effect == name]
        found[name] = [figures.shape_figure(mine[first : first + 3]) for first in range(0, len(mine), 3)]
    return found


def _replayed(report: Mapping[str, Any]) -> list[tuple[Any, ...]]:
    """Each joint with its replay errors: angle before and after, rad, speed before and after, rad/s."""
    if "replay" not in report:
        return []
    errors = [
        report["replay"][when][f"{what}_per_joint"]
        for what in ("q_rms_rad", "dq_rms_rad_s")
        for when in ("before", "after")
    ]
    return list(zip(report["joints"], *errors, strict=True))


def _candidates(report: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Selected and rejected candidates."""
    for one in report["effects"]:
        reason = _placement_text(one, report["joints"])
        yield {**one, "gain": one["heldout_gain"], "reason": reason, "selected": True}
    for one in report["rejected"]:
        yield {**one, "gain": one["selecting_gain"], "p_value": None, "selected": False}


def _placement_text(effect: Mapping[str, Any], joints: Sequence[str]) -> str:
    """Where an effect was added, and which effects are indistinguishable from it."""
    where = (
        "all joints"
        if len(effect["joints"]) == len(joints)
        else ", ".join(map(short_joint_name, effect["joints"]))
    )
    also = effect["indistinguishable"]
    return f"added, on {where}" + (f"; indistinguishable from {', '.join(also)}" if also else "")


def _parameters(report: Mapping[str, Any]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Tables of gains, delays and effect parameters, each with its name."""
    after, joints = report["after"], report["joints"]
    yield (
        "gains and delays",
        [
            row
            for name, title, unit in _EAM
            if f"{name}_ci95" in after
            for row in _parameter_rows(title, after[name], after[f"{name}_ci95"], unit, joints)
        ],
    )
    for effect in report["effects"]:
        yield (
            effect["name"],
            [
                row
                for name, p in effect["params"].items()
                for row in _parameter_rows(name, p["value"], p["ci95"], p["unit"], effect["joints"])
            ],
        )


def _parameter_rows(
    name: str, value: Any, interval: Any, unit: str, joints: Sequence[str]
) -> Iterator[dict[str, Any]]:
    """Rows of the parameter table: one if joints share the value, else one for each."""
    values, intervals = np.atleast_1d(value), np.atleast_2d(interval)
    for owner, one, (low, high) in zip(_value_owners(len(values), joints), values, intervals, strict=True):
        yield {
            "name": f"{name} {short_joint_name(owner)}".strip(),
            "value": one,
            "low": low,
            "high": high,
            "unit": unit,
            "places": _places(float(one), float(low), float(high)),
        }


def _value_owners(count: int, joints: Sequence[str]) -> Sequence[str]:
    """Owner of each of `count` values: the joint, or the index."""
    if count == 1:
        return [""]
    return joints if count == len(joints) else [f"[{place}]" for place in range(count)]


def _places(value: float, low: float, high: float) -> dict[str, float] | None:
    """Places of value and interval on an axis that contains zero, percent; None without an axis."""
    left, right = min(low, value, 0.0), max(high, value, 0.0)
    if not np.isfinite([left, right]).all() or right == left:
        return None
    marks = {"value": value, "low": low, "high": high, "zero": 0.0}
    return {name: 100 * (x - left) / (right - left) for name, x in marks.items()}
