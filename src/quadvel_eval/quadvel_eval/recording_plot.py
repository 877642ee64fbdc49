"""`quadvel plot`: what was recorded of a run, as pictures of velocity, joints, torques and the controller's loop.

Of each topic what there is: a recording of a real robot knows no true velocity, one of the joints alone no velocity at all.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import attrs
import numpy as np
import typer
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from quadvel_description.robot import JOINT_NAMES, TORQUE_LIMIT
from quadvel_nodes.messages import seconds
from quadvel_recordings.reading import RecordingError, read_messages

from .demo_figures import AXES
from .output import output_folder, replacing
from .recording import planar

Array = NDArray[np.float64]

POINTS = 4000  # of a line at most: more are not seen
LOOP = {"rate_hz": "rate, Hz", "compute_p99_us": "computing, 99 %, us", "overruns": "deadlines missed"}
SHADES = {
    "fault": "tab:red",
    "walk": "tab:green",
    "stance": "tab:blue",
    "stand_up": "tab:cyan",
    "lie_down": "tab:cyan",
}


def _joints(message: Any) -> list[float]:
    return [*message.q, *message.tau]


@attrs.frozen
class _Kind:
    """How a topic is read: the stamp of its messages, and their numbers."""

    stamp: Callable[[Any], Any]
    numbers: Callable[[Any], Any]


KINDS: Mapping[str, _Kind] = {
    "/command": _Kind(lambda m: m.stamp, lambda m: planar(m.twist)),
    "/velocity_estimate": _Kind(lambda m: m.header.stamp, lambda m: planar(m.twist.twist)),
    "/ground_truth/odom": _Kind(lambda m: m.header.stamp, lambda m: planar(m.twist.twist)),
    "/low_state": _Kind(lambda m: m.stamp, _joints),
    "/low_cmd": _Kind(lambda m: m.stamp, lambda m: list(m.q)),
    "/controller/state": _Kind(lambda m: m.stamp, lambda m: [getattr(m, name) for name in LOOP]),
}


@attrs.frozen(eq=False)
class Run:
    """begin: s, on the clock of the stamps, of the first of all; lines: of each topic that was recorded, times (n,), s since then,
    and numbers (n, k); modes: the controller's in their order, each with its beginning, s; ends: s.
    """

    begin: float
    lines: Mapping[str, tuple[Array, Array]]
    modes: list[tuple[float, str]]
    ends: float


def read_run(path: Path) -> Run:
    """Raises RecordingError where none of the topics of KINDS was recorded."""
    rows: dict[str, list[tuple[float, list[float]]]] = defaultdict(list)
    modes: list[tuple[float, str]] = []
    for topic, _, message in read_messages(path, lambda topic, _: topic in KINDS):
        time = seconds(KINDS[topic].stamp(message))
        rows[topic].append((time, KINDS[topic].numbers(message)))
        if topic == "/controller/state" and (not modes or modes[-1][1] != message.mode_name):
            modes.append((time, message.mode_name))
    if not rows:
        raise RecordingError(f"{path}: found none of the topics {', '.join(KINDS)}")
    begin = min(row[0][0] for row in rows.values())
    lines = {}
    for topic, found in rows.items():
        every = max(1, len(found) // POINTS)
        times, numbers = zip(*found[::every], strict=True)
        lines[topic] = np.array(times) - begin, np.array(numbers, float)
    ends = max(float(times[-1]) for times, _ in lines.values())
    return Run(begin, lines, [(time - begin, mode) for time, mode in modes], ends)


def velocity_figure(run: Run) -> Figure | None:
    """Commanded, estimated and, where it is known, true velocity; None without any of them."""
    names = {"/command": ("commanded", "black"), "/velocity_estimate": ("estimated", "tab:orange")}
    names["/ground_truth/odom"] = ("true", "tab:blue")
    there = [topic for topic in names if topic in run.lines]
    if not there:
        return None
    figure, panels = panels_over(run, 3, 1, (11.0, 7.0))
    for axis, panel in enumerate(panels[:, 0]):
        for topic in reversed(there):
            label, colour = names[topic]
            time, value = run.lines[topic]
            panel.plot(time, value[:, axis], color=colour, lw=0.8, label=label)
        panel.set_ylabel(AXES[axis])
    add_legend(figure, run, panels[0, 0])
    return figure


def joints_figure(run: Run) -> Figure | None:
    """Angle of each joint and where it was sent; None without low_state."""
    if "/low_state" not in run.lines:
        return None
    figure, panels = panels_over(run, 4, 3, (13.0, 9.0))
    for joint, panel in enumerate(panels.ravel()):
        if "/low_cmd" in run.lines:
            time, targets = run.lines["/low_cmd"]
            panel.plot(time, targets[:, joint], color="black", lw=0.6, label="target")
        time, numbers = run.lines["/low_state"]
        panel.plot(time, numbers[:, joint], color="tab:blue", lw=0.6, label="measured")
        panel.set_title(f"{JOINT_NAMES[joint].removesuffix('_joint')}, rad", fontsize="small", loc="left")
    add_legend(figure, run, panels[0, 0])
    return figure


def torques_figure(run: Run) -> Figure | None:
    """Torque of each joint, between its limits; None without low_state."""
    if "/low_state" not in run.lines:
        return None
    figure, panels = panels_over(run, 4, 3, (13.0, 9.0))
    time, numbers = run.lines["/low_state"]
    for joint, panel in enumerate(panels.ravel()):
        panel.plot(time, numbers[:, 12 + joint], color="tab:blue", lw=0.6, label="measured")
        panel.axhline(TORQUE_LIMIT[joint], color="tab:red", lw=0.8, ls="--", label="limit")
        panel.axhline(-TORQUE_LIMIT[joint], color="tab:red", lw=0.8, ls="--")
        panel.set_title(f"{JOINT_NAMES[joint].removesuffix('_joint')}, N m", fontsize="small", loc="left")
    add_legend(figure, run, panels[0, 0])
    return figure


def loop_figure(run: Run) -> Figure | None:
    """What the controller said of its loop; None where it said nothing."""
    if "/controller/state" not in run.lines:
        return None
    figure, panels = panels_over(run, len(LOOP), 1, (11.0, 6.0))
    time, numbers = run.lines["/controller/state"]
    for column, (panel, name) in enumerate(zip(panels[:, 0], LOOP.values(), strict=True)):
        panel.plot(time, numbers[:, column], color="tab:blue", lw=1.0)
        panel.set_ylabel(name)
    add_legend(figure, run, panels[0, 0])
    return figure


FIGURES: Mapping[str, Callable[[Run], Figure | None]] = {
    "velocity": velocity_figure,
    "joints": joints_figure,
    "torques": torques_figure,
    "loop": loop_figure,
}


def panels_over(run: Run, rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, Any]:
    """A figure with panels over the run's time, shaded by the controller's mode."""
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for panel in panels.ravel():
        panel.grid(alpha=0.3)
        panel.set_xlim(0.0, max(run.ends, 1e-3))
        for (begin, mode), (end, _) in pairwise([*run.modes, (run.ends, "")]):
            panel.axvspan(begin, end, color=_shade(mode), alpha=0.08, lw=0.0)
    for panel in panels[-1]:
        panel.set_xlabel("time, s")
    return figure, panels


def add_legend(figure: Figure, run: Run, panel: Any) -> None:
    """Above the panels: what the lines of `panel` are, and which colour is which mode."""
    lines = panel.get_legend_handles_labels()[0]
    modes = dict.fromkeys(mode for _, mode in run.modes)
    shades = [Patch(color=_shade(mode), alpha=0.3, label=mode.replace("_", " ")) for mode in modes]
    figure.legend(
        handles=[*lines, *shades], loc="outside upper left", ncols=len(lines) + len(shades), frameon=False
    )


def _shade(mode: str) -> str:
    return SHADES.get(mode, "grey")


def plot_command(
    recording: Annotated[Path, typer.Argument(help="An MCAP file or a rosbag2 folder.", show_default=False)],
    out: Annotated[Path, typer.Option(metavar="<folder>", help="Folder for the pictures.")] = Path(
        "out/plot"
    ),
) -> None:
    """Draw what was recorded of a run: velocity, joints, torques, the controller's loop.

    Colours show the controller's mode.
    """
    output_folder(out)
    run = read_run(recording)
    for name, draw in FIGURES.items():
        figure = draw(run)
        if figure is None:
            typer.echo(f"no {name}.png: nothing was recorded for it")
            continue
        with replacing(out / f"{name}.png") as draft:
            figure.savefig(draft, dpi=110)
        typer.echo(f"written: {out / name}.png")
