"""Compares two evaluations of `quadvel eval`: common figures and their difference.

It reads two finished evaluations and runs nothing; `quadvel eval` runs them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from .grid import SCHEMA
from .report import read_json

EVALUATION_FILE = "eval.json"
FIGURES_ON_BOTH_PLANTS = (
    "falls",
    "mean error, m/s",
    "largest error, m/s",
    "mean error of the yaw rate, rad/s",
    "largest error of the yaw rate, rad/s",
)
"""Figures compared on both plants."""


def read_evaluation(path: Path) -> dict[str, Any]:
    """Read an evaluation.

    Args:
        path: `eval.json`, or the folder that holds it.

    Returns:
        Content of the file.

    Raises:
        ValueError: The file is not an evaluation of this schema.
        OSError: The file is missing or unreadable.
    """
    file = path / EVALUATION_FILE if path.is_dir() else path
    if not file.exists():
        raise FileNotFoundError(f"{file}: no such file, expected what `quadvel eval` wrote")
    content = read_json(file)
    if not isinstance(content, dict) or content.get("schema") != SCHEMA or "cells" not in content:
        raise ValueError(f"{file}: no evaluation, expected schema {SCHEMA} with cells")
    return content


def comparison_figures(evaluation: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the figures to compare.

    Args:
        evaluation: Content of `eval.json`.

    Returns:
        Values by name and unit; None if undefined.
    """
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
            f"second plant: {name}": value
            for name, value in comparison_figures(second).items()
            if name in FIGURES_ON_BOTH_PLANTS
        }
    return found


def errors_on_common_runs(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the mean errors over the commands and seeds that fell in neither evaluation.

    Args:
        first: Content of one `eval.json`.
        second: Content of the other.

    Returns:
        Mean error of each, m/s; None without common runs.
    """
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
    """Create a table of two evaluations, one row per figure, with second minus first.

    Args:
        evaluations: Exactly two contents of `eval.json`, by name.

    Returns:
        The table.
    """
    (first_name, first), (second_name, second) = evaluations.items()
    table = Table("", first_name, second_name, "difference", title="Two evaluations")
    before, after = comparison_figures(first), comparison_figures(second)
    rows = {name: (before.get(name), after.get(name)) for name in dict.fromkeys((*before, *after))}
    common = errors_on_common_runs(first, second)
    if common:
        rows["mean error of the common runs, m/s"] = common
    for name, (a, b) in rows.items():
        difference = "" if a is None or b is None else f"{b - a:+.4g}"
        table.add_row(name, _number(a), _number(b), difference)
    return table


def _number(value: float | None) -> str:
    """Number with four significant digits; a dash for None."""
    return "–" if value is None else f"{value:.4g}"
