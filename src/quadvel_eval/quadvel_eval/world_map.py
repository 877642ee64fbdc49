"""Draws a world from above (`quadvel world`).

`quadvel_sim.world` reads the world file. The map is in the world frame, m.
"""

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

from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_recordings.output import output_file
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from quadvel_sim.world import SHIPPED_WORLDS, World

from .report import write_figure

FIGURE_WIDTH_IN = 10.0  # inches
MIN_MAP_M = 4.0  # smallest height and width of a map, for a straight path
FORMATS = (".png", ".svg", ".pdf")
GROUND_COLOURS = {"grass": "#a9c48f", "gravel": "#cfc7b8", "paved": "#d9dadc"}
LEADER_COLOUR, OTHER_COLOUR = "#1a9641", "#4575b4"


def world_command(
    world: Annotated[str, typer.Argument(help=f"{', '.join(SHIPPED_WORLDS)} or a YAML file.")],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="The picture to write, PNG, SVG or PDF.", show_default="out/WORLD.png"
        ),
    ] = None,
) -> None:
    """Check a world file, and draw the world from above.

    \b
    For example:
      quadvel world campus --out out/campus.png
    """
    loaded = World.load(world)
    Simulator(
        SimulatorConfig(robot=load_robot(DEFAULT_ROBOT), world=loaded)
    )  # refuses an obstacle at the start
    path = output_file(Path(f"out/{Path(world).stem}.png") if out is None else out)
    if path.suffix not in FORMATS:
        raise ValueError(f"{path}: found the suffix {path.suffix!r}, expected {', '.join(FORMATS)}")
    write_figure(path, draw_world(loaded))
    note = "" if loaded.persons else "; it has no person to follow"
    Console(markup=False, soft_wrap=True).print(f"written: {path}{note}")


def draw_world(world: World) -> Figure:
    """Draw ground, obstacles and paths of the people; the paths of leaders are green.

    Args:
        world: The world.

    Returns:
        The figure.
    """
    figure = Figure(layout="constrained")
    axes = figure.subplots()
    _ground(axes, world)
    _obstacles(axes, world)
    _paths(axes, world)
    axes.plot(0.0, 0.0, ">", color="black", markersize=7, label="the robot's start", zorder=6)
    axes.set(xlabel="x, m", ylabel="y, m", title=world.name, aspect="equal")
    axes.autoscale_view()
    for limits, set_limits in ((axes.get_xlim(), axes.set_xlim), (axes.get_ylim(), axes.set_ylim)):
        middle, half = float(np.mean(limits)), 0.5 * max(float(np.ptp(limits)), MIN_MAP_M)
        set_limits(middle - half, middle + half)
    across, up = np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())
    figure.set_size_inches(
        FIGURE_WIDTH_IN, float(np.clip(FIGURE_WIDTH_IN * up / across, 2.5, FIGURE_WIDTH_IN)) + 1.0
    )
    figure.legend(loc="outside lower center", ncols=5, fontsize="small", frameon=False)
    return figure


def _ground(axes: Axes, world: World) -> None:
    """Draw patches and hills."""
    for patch in world.patches:
        _rectangle(
            axes, patch.position, patch.size, patch.yaw, GROUND_COLOURS[patch.surface], label=patch.surface
        )
    for hill in world.hills:
        _rectangle(
            axes, hill.position, hill.size, hill.yaw, GROUND_COLOURS[hill.surface], edge="0.5", label="hill"
        )
        _rectangle(axes, hill.position, hill.top, hill.yaw, "none", edge="0.5")
        axes.annotate(
            f"{hill.slope:g}°",
            (hill.position[0], hill.position[1]),
            ha="center",
            va="center",
            fontsize=7,
            zorder=5,
        )


def _obstacles(axes: Axes, world: World) -> None:
    """Draw walls, boxes, tables and trees."""
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


def _paths(axes: Axes, world: World) -> None:
    """Draw the paths of the people."""
    for person in world.persons:
        path = np.vstack([person.path, person.path[:1]]) if person.closed else person.path
        label = _once(axes, "leader" if person.led else "others")
        color, width = (LEADER_COLOUR, 1.8) if person.led else (OTHER_COLOUR, 1.0)
        axes.plot(*path.T, color=color, linewidth=width, label=label, zorder=5)
        if np.hypot(*np.ptp(path, axis=0)) < 0.5:  # standing people
            axes.plot(*path[-1], "o", color=color, markersize=3, zorder=5)


def _rectangle(
    axes: Axes,
    centre: ArrayLike,
    size: ArrayLike,
    yaw: float,
    color: str,
    edge: str = "none",
    label: str | None = None,
) -> None:
    """Add a rectangle of `size` (2,) m around `centre`, rotated by `yaw` degrees."""
    corner, (along, across) = np.asarray(centre) - 0.5 * np.asarray(size), np.asarray(size)
    axes.add_patch(
        Rectangle(
            tuple(corner), along, across, angle=yaw, rotation_point="center", facecolor=color, edgecolor=edge,
            linewidth=0.8, label=label and _once(axes, label), zorder=2,
        )
    )  # fmt: skip


def _once(axes: Axes, label: str) -> str | None:
    """Return `label`, unless the legend holds it already."""
    return None if label in axes.get_legend_handles_labels()[1] else label
