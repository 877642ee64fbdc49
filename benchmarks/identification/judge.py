"""Judge of the contest: compares a file of answers with the truth of the logs.

An answer file is JSON:

    {"schema": 1, "entrant": "mine", "logs": {"log_000": {
        "effects": [{"name": "coulomb_friction", "joints": ["FR_hip_joint"],
                     "params": {"c": {"value": 0.4}}, "indistinguishable": []}],
        "depends_on": ["FR_hip_joint/dq"], "torque": [[1.2, ...], ...], "seconds": 3.1}}}

`torque` holds a row for each row of the log whose torque is nan, in N m. All else may be left out.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.identification.verdicts import named_joints_are_right, naming_verdict, parameter_errors

SCHEMA = 1
GROUPS = {
    "none": "no effect, none named",
    "alone": "one effect, named",
    "together": "several effects, all named",
    "outside": "effect without a name, its signal named",
}
"""Groups of logs, and when a naming is right."""

Json = dict[str, Any]


def read_answers(path: Path, truths: Mapping[str, Json]) -> Json:
    """Read and check a file of answers.

    Args:
        path: The file.
        truths: Ground truth by name of the log.

    Returns:
        Its content.

    Raises:
        ValueError: The file is no such JSON, or the torque of a log is missing or has another shape.
    """
    try:
        content: Json = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: found {type(content).__name__}, expected an object with the key schema")
    missing = {"schema", "entrant", "logs"} - content.keys()
    if missing:
        raise ValueError(f"{path}: found no {', '.join(sorted(missing))}")
    if content.get("schema") != SCHEMA:
        raise ValueError(f"{path}: schema: found {content.get('schema')}, expected {SCHEMA}")
    for name, truth in truths.items():
        found = np.shape(content["logs"].get(name, {}).get("torque", ()))
        expected = np.shape(truth["torque"])
        if found != expected:
            raise ValueError(f"{path}: logs/{name}/torque: found shape {found}, expected {expected}")
    return content


def judge_log(answer: Json, truth: Json) -> Json:
    """Judge the answer about one log.

    Args:
        answer: Its entry in the file of answers.
        truth: Ground truth of the log.

    Returns:
        `group`, `right` (naming), `joints` (whether the named joints are right; None without an
        effect), `params` (relative errors of parameters), `error` (mean squared error of the
        predictions, over that of the true model), `seconds` (None if not given).
    """
    effects = [{"indistinguishable": [], "params": {}, **entry} for entry in answer.get("effects", [])]
    signals = answer.get("depends_on", [])
    verdict = "structured" if signals else "white"
    report = {
        "effects": effects,
        "after": {},
        "unexplained": {"verdict": verdict, "depends_on": signals},
    }
    difference = np.asarray(answer["torque"], dtype=float) - np.asarray(truth["torque"])
    nameable = truth["group"] in ("alone", "together")
    return {
        "group": truth["group"],
        "right": naming_verdict(report, truth) == "right",
        "joints": named_joints_are_right(report, truth) if nameable else None,
        "params": parameter_errors(effects, truth),
        "error": float(np.mean(difference**2)) / truth["floor"],
        "seconds": answer.get("seconds"),
    }


def judge(content: Json, truths: Mapping[str, Json]) -> Json:
    """Judge a file of answers.

    Args:
        content: Content of the file.
        truths: Ground truth by name of the log.

    Returns:
        `entrant`, and `logs`, the judgement of each log by name.
    """
    logs = {name: judge_log(content["logs"][name], truth) for name, truth in truths.items()}
    return {"entrant": content["entrant"], "logs": logs}


def judgement_table(judgements: Sequence[Json]) -> str:
    """Format judgements of the same logs as a Markdown table.

    Args:
        judgements: Results of `judge`.

    Returns:
        The table: namings, joints, parameters, predictions, and time of each entrant.
    """
    groups = [
        group for group in GROUPS if any(log["group"] == group for log in judgements[0]["logs"].values())
    ]
    heads = [
        "entrant",
        *(GROUPS[group] for group in groups),
        "right joints",
        "parameters, median error",
        "prediction error over that of the true model: median, largest",
        "s of a core for a log",
    ]
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for one in judgements:
        logs = list(one["logs"].values())
        namings = [[log["right"] for log in logs if log["group"] == group] for group in groups]
        joints = [log["joints"] for log in logs if log["joints"] is not None]
        errors = [log["error"] for log in logs]
        params = [error for log in logs for error in log["params"]]
        seconds = [log["seconds"] for log in logs if log["seconds"] is not None]
        cells = [
            one["entrant"],
            *(_count(naming) for naming in namings),
            _count(joints),
            f"{100 * np.median(params):.1f} % of {len(params)}" if params else "–",
            f"{np.median(errors):.2f}, {max(errors):.2f}",
            f"{np.median(seconds):.1f}" if seconds else "–",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _count(right: Sequence[bool]) -> str:
    """How many are right, of how many."""
    return f"{sum(right)} of {len(right)}" if right else "–"
