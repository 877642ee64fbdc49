"""Writes results as JSON, CSV, pictures and tables; runs no simulation.

Each file is replaced atomically. Other files of the folder are kept.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from quadvel_description.arrays import Array
from quadvel_recordings.output import atomic_write

CSV_COLUMNS = (
    "plant",
    *("vx", "vy", "wz", "seed"),
    *("mean_vx", "mean_vy", "mean_wz"),
    *("error_xy", "error_wz", "fell"),
)


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Args:
        path: The file.

    Returns:
        Its content.

    Raises:
        ValueError: The file is not JSON; the message names it.
        OSError: The file is unreadable.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError, too
        raise ValueError(f"{path}: is not JSON: {error}") from None


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file.

    Args:
        path: The file.
        content: Its content. NaN and infinity raise a ValueError.
    """
    with atomic_write(path) as draft:
        draft.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure in the format of the suffix.

    Args:
        path: The file.
        figure: The figure.
    """
    with atomic_write(path) as draft:
        figure.savefig(draft, dpi=120)


def write_evaluation(folder: Path, evaluation: Mapping[str, Any]) -> None:
    """Write eval.json, eval.csv and eval.png.

    Args:
        folder: Folder of the files.
        evaluation: Result of `grid.evaluate`, with its setup.
    """
    write_json(folder / "eval.json", evaluation)
    with atomic_write(folder / "eval.csv") as draft, draft.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(CSV_COLUMNS)
        for plant, one in (("usual", evaluation), ("second", evaluation["second_plant"])):
            for cell in one["cells"]:
                mean = cell["mean"] or [None] * 3
                errors = cell["error_xy"], cell["error_wz"]
                writer.writerow([plant, *cell["command"], cell["seed"], *mean, *errors, int(cell["fell"])])
    write_figure(folder / "eval.png", error_heatmap(evaluation["cells"]))


def error_heatmap(cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the tracking error over vx and vy, one panel per yaw rate, as mean over the seeds.

    Args:
        cells: Cells of `eval.json`.

    Returns:
        Figure; a cross marks a fall.
    """
    rates = sorted({cell["command"][2] for cell in cells})
    return error_heatmaps(
        {f"wz = {rate:g} rad/s": [c for c in cells if c["command"][2] == rate] for rate in rates}
    )


def error_heatmaps(panels: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """Draw the tracking error over vx and vy, one panel per title, with one colour scale.

    Args:
        panels: Cells (command, error_xy, fell) of one grid, by title.

    Returns:
        Figure; a cross marks a fall.
    """
    cells = [cell for some in panels.values() for cell in some]
    vx, vy = (sorted({cell["command"][axis] for cell in cells}) for axis in range(2))
    largest = max((cell["error_xy"] for cell in cells if not cell["fell"]), default=1.0)
    figure = Figure(figsize=(1.5 + 4.0 * len(panels), 1.6 + 0.32 * len(vx)), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for panel, (title, some) in zip(axes, panels.items(), strict=True):
        shown = panel.imshow(
            _mean_errors(panel, some, vx, vy), origin="lower", aspect="auto", vmin=0.0, vmax=largest
        )
        panel.set_xticks(range(len(vy)), [f"{y:g}" for y in vy])
        panel.set_yticks(range(len(vx)), [f"{x:g}" for x in vx])
        panel.set_xlabel("vy, m/s")
        panel.set_title(title)
    axes[0].set_ylabel("vx, m/s")
    figure.colorbar(shown, ax=axes, label="error of the mean velocity, m/s")
    return figure


def _mean_errors(
    panel: Axes, cells: Sequence[Mapping[str, Any]], vx: Sequence[float], vy: Sequence[float]
) -> Array:
    """Mean errors over the seeds (vx, vy), nan if all fell; draws a cross at each fall."""
    image = np.full((len(vx), len(vy)), np.nan)
    for i, x in enumerate(vx):
        for j, y in enumerate(vy):
            here = [cell for cell in cells if list(cell["command"][:2]) == [x, y]]
            stood = [cell["error_xy"] for cell in here if not cell["fell"]]
            if stood:
                image[i, j] = np.mean(stood)
            if len(stood) < len(here):
                panel.text(j, i, "×", ha="center", va="center", color="tab:red", size="large")
    return image


def evaluation_table(evaluation: Mapping[str, Any]) -> Table:
    """Create a table of the aggregates on both plants.

    Args:
        evaluation: Result of `grid.evaluate`.

    Returns:
        The table.
    """
    plants = [evaluation, evaluation["second_plant"]]
    table = Table("", "usual plant", "second plant", title="Velocity tracking")
    for name, show in AGGREGATES.items():
        table.add_row(name, *(show(one) for one in plants))
    for name in evaluation["estimator"]:
        figures = [one["estimator"].get(name) for one in plants]
        rmse = [", ".join(f"{x:.3f}" for x in one["rmse"]) if one else "fell" for one in figures]
        table.add_row(f"{name} estimator, RMSE x, y, z, m/s", *rmse)
        table.add_row(
            f"{name} estimator, drift",
            *(f"{100 * one['drift']:.1f} % of the path length" if one else "" for one in figures),
        )
    return table


def _worst_command(one: Mapping[str, Any], error: str) -> str:
    """Command with the largest error, as text."""
    worst = max(
        (cell for cell in one["cells"] if not cell["fell"]), key=lambda cell: cell[error], default=None
    )
    return "" if worst is None else ", ".join(f"{x:g}" for x in worst["command"])


def _seconds(value: float | None) -> str:
    """Time as text; empty for None."""
    return "" if value is None else f"{value:.2f} s"


def _drift(one: Mapping[str, Any]) -> str:
    """Drift as text."""
    drift = one["stance"]["drift_10s_m"]
    return "fell" if drift is None else f"{100 * drift:.2f} cm"


AGGREGATES: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "runs, falls": lambda one: f"{len(one['cells'])}, {one['falls']}",
    "error, mean and largest": lambda one: f"{one['mean_error_xy']:.3f}, {one['max_error_xy']:.3f} m/s",
    "largest at (vx, vy, wz)": lambda one: _worst_command(one, "error_xy"),
    "yaw rate error, mean and largest": lambda one: (
        f"{one['mean_error_wz']:.3f}, {one['max_error_wz']:.3f} rad/s"
    ),
    "largest at (vx, vy, wz) ": lambda one: _worst_command(one, "error_wz"),
    "delay of the velocity": lambda one: _seconds(one["delay_xy"]),
    "delay of the yaw rate": lambda one: _seconds(one["delay_wz"]),
    "jitter": lambda one: f"{one['jitter']:.5f} rad",
    "drift in 10 s of standing": _drift,
}
"""Rows of the table: name, and function from the evaluation of a plant to text."""


def segment_table(segments: Sequence[Mapping[str, Any]]) -> Table:
    """Create a table of the commanded and measured velocity of each segment of a demo.

    Args:
        segments: Segments of `summary.json`.

    Returns:
        The table.
    """
    columns = ("command vx, vy, wz", "measured vx, vy, wz", "error xy, m/s", "error wz, rad/s")
    table = Table(*columns, title="Segments")
    for segment in segments:
        command, mean = (", ".join(f"{x:+.2f}" for x in segment[key]) for key in ("command", "mean"))
        table.add_row(command, mean, f"{segment['error_xy']:.3f}", f"{segment['error_wz']:.3f}")
    return table
