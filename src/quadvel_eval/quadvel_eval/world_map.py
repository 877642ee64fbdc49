"""`quadvel world`: a world from above, as a picture."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from numpy.typing import ArrayLike
from rich.console import Console

from quadvel_sim.world import SHIPPED_WORLDS, World

from .output import output_file
from .report import write_figure

WIDTH = 10.0  # inches
FORMATS = (".png", ".svg", ".pdf")
GROUND = {"grass": "#a9c48f", "gravel": "#cfc7b8", "paved": "#d9dadc"}
LED, OTHER = "#1a9641", "#4575b4"


def world_command(
    world: Annotated[str, typer.Argument(help=f"{', '.join(SHIPPED_WORLDS)} or a YAML file.")],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="The picture to write, PNG, SVG or PDF.", show_default="out/WORLD.png"
        ),
    ] = None,
) -> None:
    """Check a world's file, and draw the world from above.

    \b
    For example:
      quadvel world campus --out out/campus.png
    """
    loaded = World.load(world)
    path = output_file(Path(f"out/{loaded.name}.png") if out is None else out)
    if path.suffix not in FORMATS:
        raise ValueError(f"{path}: found the suffix {path.suffix!r}, expected {', '.join(FORMATS)}")
    write_figure(path, draw(loaded))
    Console(soft_wrap=True).print(f"written: {path}")


def draw(world: World) -> Figure:
    """Ground, what stands on it, and the ways of the persons, who are led in green."""
    figure = Figure(layout="constrained")
    axes = figure.subplots()
    _ground(axes, world)
    _things(axes, world)
    _ways(axes, world)
    axes.plot(0.0, 0.0, ">", color="black", markersize=7, label="the robot's start", zorder=6)
    axes.set(xlabel="x, m", ylabel="y, m", title=world.name, aspect="equal")
    axes.autoscale_view()
    across, up = np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())
    figure.set_size_inches(WIDTH, float(np.clip(WIDTH * up / across, 2.5, WIDTH)) + 1.0)
    figure.legend(loc="outside lower center", ncols=5, fontsize="small", frameon=False)
    return figure


def _ground(axes: Axes, world: World) -> None:
    for patch in world.patches:
        _rectangle(axes, patch.position, patch.size, patch.yaw, GROUND[patch.surface], label=patch.surface)
    for hill in world.hills:
        _rectangle(axes, hill.position, hill.size, hill.yaw, GROUND[hill.surface], edge="0.5", label="hill")
        _rectangle(axes, hill.position, hill.top, hill.yaw, "none", edge="0.5")
        axes.annotate(
            f"{hill.slope:g}°",
            (hill.position[0], hill.position[1]),
            ha="center",
            va="center",
            fontsize=7,
            zorder=5,
        )


def _things(axes: Axes, world: World) -> None:
    for wall in world.walls:
        for begin, end in pairwise(wall.points):
            length = float(np.hypot(*(end - begin))) + wall.thickness
            yaw = float(np.degrees(np.arctan2(*(end - begin)[::-1])))
            _rectangle(
                axes, 0.5 * (begin + end), [length, wall.thickness], yaw, "0.3", edge="0.3", label="wall"
            )
    for box in world.boxes:
        _rectangle(axes, box.position, box.size[:2], box.yaw, "#b08d6a", label="box")
    for table in world.tables:
        _rectangle(axes, table.position, table.size, table.yaw, "#e0b780", edge="0.4", label="table")
    for trees in world.trees:
        for position in trees.positions:
            axes.add_patch(
                Circle(tuple(position), trees.radius, color="#4d3319", label=_once(axes, "tree"), zorder=4)
            )


def _ways(axes: Axes, world: World) -> None:
    for person in world.persons:
        way = np.vstack([person.path, person.path[:1]]) if person.closed else person.path
        label = _once(axes, "who is led" if person.led else "others")
        color, width = (LED, 1.8) if person.led else (OTHER, 1.0)
        axes.plot(*way.T, color=color, linewidth=width, label=label, zorder=5)
        if np.hypot(*np.ptp(way, axis=0)) < 0.5:  # who stands
            axes.plot(*way[-1], "o", color=color, markersize=3, zorder=5)


def _rectangle(
    axes: Axes,
    centre: ArrayLike,
    size: ArrayLike,
    yaw: float,
    color: str,
    edge: str = "none",
    label: str | None = None,
) -> None:
    """`size` (2,) in m around `centre`, turned by `yaw` deg."""
    corner, (along, across) = np.asarray(centre) - 0.5 * np.asarray(size), np.asarray(size)
    axes.add_patch(
        Rectangle(
            tuple(corner), along, across, angle=yaw, rotation_point="center", facecolor=color, edgecolor=edge,
            linewidth=0.8, label=label and _once(axes, label), zorder=2,
        )
    )  # fmt: skip


def _once(axes: Axes, label: str) -> str | None:
    """`label`, unless the legend has it already."""
    return None if label in axes.get_legend_handles_labels()[1] else label
