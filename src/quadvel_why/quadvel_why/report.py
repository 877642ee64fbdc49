"""What a diagnosis says: sentences for the terminal, JSON for programs, and one picture.

`diagnosis` finds the cause, and `cli` prints or saves the result.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from .cause import Trace
from .diagnosis import Diagnosis, Finding
from .run import Run

SCHEMA = 1
MEASURED_COLOUR, EXPECTED_COLOUR, SPAN_COLOUR = "black", "tab:orange", "tab:red"
NO_WALK = (
    "no walk is reported in this recording, and the limits are those of healthy walks: friction of the joints, or "
    "another motion, may look like this; `quadvel identify` distinguishes them"
)


def summary(run: Run, diagnosis: Diagnosis) -> str:
    """Describe a diagnosis in a few lines.

    Args:
        run: The run.
        diagnosis: The diagnosis.

    Returns:
        The lines, for people.
    """
    lines = [f"{run.name}: {run.duration:.1f} s, {len(run.time)} states, {_fate(run)}"]
    found = diagnosis.finding
    if found is None:
        lines.append(f"every link holds: none of the {len(diagnosis.held)} causes examined was found")
    else:
        begin, end = found.measurement.span
        lines += [
            f"{found.cause.link.value} breaks: {found.cause.name()} ({begin:.2f} to {end:.2f} s)",
            f"  {found.measurement.sentence}",
            f"  measured {found.measurement.value:.3g} {found.cause.unit}, limit {found.limit:.3g}",
        ]
        for name, experiment in found.measurement.alternatives:
            lines.append(f"  or {name}, which looks the same here; to tell them apart: {experiment}")
        lines += [
            f"  what to do: {found.cause.remedy}",
            *([] if _reports_walk(run) else [f"  {NO_WALK}"]),
            f"  {len(diagnosis.held)} causes before it hold; later ones were not examined: repair, record and ask again",
        ]
    lacking: dict[str, list[str]] = defaultdict(list)
    for name, why in diagnosis.skipped.items():
        if not why.startswith("after "):
            lacking[why].append(name)
    lines += [f"not examined, because {why}: {', '.join(names)}" for why, names in lacking.items()]
    return "\n".join(lines)


def _reports_walk(run: Run) -> bool:
    """Whether a controller reported that the robot walked."""
    return run.modes is not None and "walk" in run.modes.name


def _fate(run: Run) -> str:
    """How the run ended, as the controller reported it."""
    modes = run.modes
    if modes is None or not modes.name:
        return "no modes recorded"
    stopped = f", stopped by {modes.stopped_by}" if modes.stopped_by else ""
    recovered = f", after a reset from {', '.join(modes.recovered_from)}" if modes.recovered_from else ""
    return f"last mode {modes.name[-1]}{stopped}{recovered}"


def to_json(run: Run, diagnosis: Diagnosis) -> dict[str, Any]:
    """Convert a diagnosis for why.json.

    Args:
        run: The run.
        diagnosis: The diagnosis.

    Returns:
        The finding (None if every link holds), the numbers of the causes that hold, and why others were skipped.
    """
    found = diagnosis.finding
    return {
        "schema": SCHEMA,
        "recording": run.name,
        "duration_s": run.duration,
        "reports_walk": _reports_walk(run),
        "finding": None if found is None else _finding_json(found),
        "held": {name: float(each.value) for name, each in diagnosis.held.items()},
        "skipped": diagnosis.skipped,
    }


def _finding_json(found: Finding) -> dict[str, Any]:
    return {
        "cause": found.cause.name(),
        "link": found.cause.link.value,
        "value": float(found.measurement.value),
        "limit": float(found.limit),
        "unit": found.cause.unit,
        "span_s": [float(t) for t in found.measurement.span],
        "sentence": found.measurement.sentence,
        "alternatives": dict(found.measurement.alternatives),
        "remedy": found.cause.remedy,
    }


def picture(found: Finding) -> Figure:
    """Draw the signal and what was expected: the span in which it shows, and the whole run.

    Args:
        found: The finding; it has at least one trace.

    Returns:
        The figure.
    """
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    near, whole = figure.subplots(2, 1, height_ratios=(3, 1))
    trace, (begin, end) = found.measurement.traces[0], found.measurement.span
    rows = (trace.time >= begin) & (trace.time <= end)
    _draw(near, trace, rows if rows.any() else np.ones(len(trace.time), bool), width=1.2)
    near.set_title(f"{found.cause.name()}: {trace.title}", loc="left", fontsize="medium")
    near.legend(loc="upper right", fontsize="small")
    _draw(whole, trace, np.ones(len(trace.time), bool), width=0.5)
    whole.axvspan(begin, end, color=SPAN_COLOUR, alpha=0.2, lw=0)
    whole.set_xlabel("time, s")
    return figure


def _draw(axes: Any, trace: Trace, rows: Any, width: float) -> None:
    axes.plot(trace.time[rows], trace.measured[rows], color=MEASURED_COLOUR, lw=width, label="measured")
    axes.plot(trace.time[rows], trace.expected[rows], color=EXPECTED_COLOUR, lw=width, label="expected")
    axes.margins(x=0.0)
    axes.grid(alpha=0.3)
