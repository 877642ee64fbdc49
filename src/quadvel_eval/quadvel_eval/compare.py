"""Two evaluations of `quadvel eval` side by side: what both measured, and the difference."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from .grid import SCHEMA
from .report import read_json

EVALUATION = "eval.json"
ON_BOTH = (
    "falls",
    "mean error, m/s",
    "largest error, m/s",
    "mean error of the yaw rate, rad/s",
    "largest error of the yaw rate, rad/s",
)
"""Figures that are told of both plants."""


def read_evaluation(path: Path) -> dict[str, Any]:
    """The evaluation in a file, or in the folder that holds it. ValueError or OSError, one sentence."""
    file = path / EVALUATION if path.is_dir() else path
    if not file.exists():
        raise FileNotFoundError(f"{file}: no such file, expected what `quadvel eval` wrote")
    content = read_json(file)
    if not isinstance(content, dict) or content.get("schema") != SCHEMA or "cells" not in content:
        raise ValueError(f"{file}: no evaluation, expected schema {SCHEMA} with cells")
    return content


def figures(evaluation: Mapping[str, Any]) -> dict[str, float | None]:
    """What is compared, by name and unit."""
    drift = evaluation["stance"]["drift_10s_m"]
    costs = [cost for cost in evaluation["cot"] if cost is not None]
    found = {
        "runs": float(len(evaluation["cells"])),
        "falls": float(evaluation["falls"]),
        "mean error, m/s": evaluation["mean_error_xy"],
        "largest error, m/s": evaluation["max_error_xy"],
        "mean error of the yaw rate, rad/s": evaluation["mean_error_wz"],
        "largest error of the yaw rate, rad/s": evaluation["max_error_wz"],
        "delay of the velocity, s": evaluation["delay_xy"],
        "delay of the yaw rate, s": evaluation["delay_wz"],
        "jitter, rad": evaluation["jitter"],
        "cost of transport, mean": float(np.mean(costs)) if costs else None,
        "drift in 10 s of standing, m": drift,
    }
    for name, errors in evaluation["estimator"].items():
        found |= {f"{name} estimator, largest RMSE, m/s": max(errors["rmse"])}
    if second := evaluation.get("second_plant"):
        found |= {
            f"second plant: {name}": value for name, value in figures(second).items() if name in ON_BOTH
        }
    return found


def common_errors(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[float, float] | None:
    """Mean error (m/s) of each over the commands and seeds that both went through; None where there are none."""
    found = [
        {(*cell["command"], cell["seed"]): cell["error_xy"] for cell in one["cells"] if not cell["fell"]}
        for one in (first, second)
    ]
    both = sorted(found[0].keys() & found[1].keys())
    if not both:
        return None
    mean_first, mean_second = (float(np.mean([errors[key] for key in both])) for errors in found)
    return mean_first, mean_second


def comparison_table(evaluations: Mapping[str, Mapping[str, Any]]) -> Table:
    """Two evaluations by name, a row a figure, and the second minus the first."""
    (first_name, first), (second_name, second) = evaluations.items()
    table = Table("", first_name, second_name, "difference", title="Two evaluations")
    before, after = figures(first), figures(second)
    rows = {name: (before.get(name), after.get(name)) for name in dict.fromkeys((*before, *after))}
    common = common_errors(first, second)
    if common:
        rows["mean error of the runs that both went through, m/s"] = common
    for name, (a, b) in rows.items():
        difference = "" if a is None or b is None else f"{b - a:+.4g}"
        table.add_row(name, _number(a), _number(b), difference)
    return table


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
