"""Checks the file of a new quadruped, MJCF or URDF, and writes its folder (`quadvel robot check`)."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console

from quadvel_description.arrays import Array
from quadvel_description.found_robot import FoundRobot, find_robot
from quadvel_description.found_robot_checks import check_found_robot
from quadvel_description.quadruped import JOINT_NAMES, KINDS, LEGS
from quadvel_description.robot import UNDECIDED
from quadvel_description.robot_folder import robot_files
from quadvel_recordings.output import created_folder, output_folder

from .report import write_figure

PICTURE = "joints.png"
MOVE_RAD = 0.4
"""How far the picture moves each joint, rad."""


def check_command(
    file: Annotated[Path, typer.Argument(help="The robot: MJCF or URDF.", show_default=False)],
    out: Annotated[
        Path, typer.Option(metavar="<folder>", help="Folder of the robot to write, for --robot.")
    ] = Path("out/robot"),
    force: Annotated[
        bool, typer.Option("--force", help="Replace the files of this folder, your numbers included.")
    ] = False,
) -> None:
    """Check the MJCF or URDF of a new quadruped, and write its folder.

    It matches the twelve joints to legs by place and chain, and prints order, signs, limits and what is
    missing or not symmetric. A robot with an arm, wheels or another number of joints is refused. The
    folder has a robot.yaml to complete, and the robot in our names, order and signs, as MJCF and URDF;
    a picture shows each joint, moved.

    \b
    For example:
      quadvel robot check go2.urdf --out out/go2

    \b
    Exit codes:
      0  the folder is written; findings and numbers to decide may be left
      1  the legs or feet do not fit the stack's kinematics; nothing is written
      2  refused: no quadruped with twelve joints, a wrong argument or file, or the folder has a robot
    """
    output_folder(out)
    if (numbers := out / "robot.yaml").exists() and not force:
        raise FileExistsError(f"{numbers}: exists, expected none; --force replaces it")
    found = find_robot(file)
    findings = check_found_robot(found)
    console = Console(markup=False, soft_wrap=True, highlight=False)
    console.print(describe_joints(found))
    for finding in findings:
        console.print(f"{'wrong' if finding.fatal else 'note '} {finding.code:13} {finding.text}")
    if any(finding.fatal for finding in findings):
        raise typer.Exit(1)
    names = write_robot_folder(found, out)
    console.print(f"written: {out} ({', '.join(names)})")
    undecided = [line.partition(":")[0] for line in numbers.read_text().splitlines() if _is_undecided(line)]
    if undecided:
        console.print(f"to decide in {numbers}: {', '.join(undecided)}")


def _is_undecided(line: str) -> bool:
    """Return whether a line of robot.yaml waits for a number."""
    return line.endswith(f": {UNDECIDED}")


def write_robot_folder(found: FoundRobot, out: Path) -> tuple[str, ...]:
    """Write the folder of a robot: all files or none. Other files in it are kept.

    Args:
        found: The robot, without a fatal finding.
        out: The folder.

    Returns:
        Names of the files.
    """
    with created_folder(out), TemporaryDirectory(dir=out, prefix=".robot-") as folder:
        drafts = Path(folder)
        for name, text in robot_files(found).items():
            (drafts / name).write_text(text, encoding="utf-8")
        write_figure(drafts / PICTURE, draw_joints(found))
        names = tuple(sorted(draft.name for draft in drafts.iterdir()))
        for name in names:
            (drafts / name).replace(out / name)
    return names


def describe_joints(found: FoundRobot) -> str:
    """Describe the joints in a table, in our order.

    Args:
        found: The robot.

    Returns:
        Text of several lines.
    """

    def text(value: float) -> str:
        return f"{value:9.3f}" if np.isfinite(value) else "  missing"

    lines = [
        f"{found.name or found.path.name}: {found.mass:.2f} kg, 12 joints, "
        f"{int(np.isfinite(found.foot_radii).sum())} feet, IMU {'missing' if found.imu is None else 'found'}",
        f"{'joint':15} {'in the file':24} {'no.':>3} axis {'lower rad':>9} {'upper rad':>9} "
        f"{'torque Nm':>9} {'speed rad/s':>11}",
    ]
    for joint in found.joints:
        axis = ("-" if joint.sign < 0 else "+") + ("x" if "hip" in joint.name else "y")
        numbers = " ".join(map(text, (joint.lower, joint.upper, joint.torque, joint.speed)))
        lines.append(f"{joint.name:15} {joint.source:24} {joint.number:3}   {axis} {numbers}")
    return "\n".join(lines)


def draw_joints(found: FoundRobot) -> Figure:
    """Draw each leg with one joint moved in the positive direction of our convention.

    Args:
        found: The robot, with feet.

    Returns:
        The figure: a row for each kind of joint, a column for each leg.
    """
    figure = Figure(figsize=(11.0, 8.0), layout="constrained")
    axes = figure.subplots(len(KINDS), len(LEGS))
    for i, name in enumerate(JOINT_NAMES):
        leg, kind = divmod(i, len(KINDS))
        _draw_joint(axes[kind, leg], found, leg, kind)
        joint = found.joints[i]
        axes[kind, leg].set_title(
            f"{name}\n{joint.source}{', turned' if joint.sign < 0 else ''}", fontsize="small"
        )
    figure.suptitle(
        f"Each joint moved by {MOVE_RAD} rad in our convention (orange); hips from behind, others from the right"
    )
    return figure


def _draw_joint(axes: Axes, found: FoundRobot, leg: int, kind: int) -> None:
    """Draw a leg before (grey) and after (orange) the motion of one joint."""
    joints = found.joints[len(KINDS) * leg :][: len(KINDS)]
    rest = np.array([np.clip(0.0, joint.lower, joint.upper) for joint in joints])
    moved = rest.copy()
    moved[kind] += MOVE_RAD
    across = -1.0 if kind == 0 else 1.0  # from behind, y points to the left
    for angles, colour in ((rest, "#999999"), (moved, "#e6550d")):
        points = leg_points(found, leg, angles)
        horizontal = across * points[:, 1 if kind == 0 else 0]
        axes.plot(horizontal, points[:, 2], "o-", color=colour, linewidth=2, markersize=4)
    axes.set(aspect="equal")
    axes.margins(0.2)
    axes.set_xlabel("y, m, to the left" if kind == 0 else "x, m, forward", fontsize="x-small")
    if kind == 0:
        axes.xaxis.set_major_formatter(lambda value, _: f"{-value:g}")
    axes.tick_params(labelsize="x-small")


def leg_points(found: FoundRobot, leg: int, angles: Array) -> Array:
    """Compute hip joint, thigh joint, calf joint and foot of a leg.

    Args:
        found: The robot.
        leg: Index of the leg.
        angles: Hip, thigh, calf, (3,), rad.

    Returns:
        Places, (4, 3), m, trunk frame.
    """
    points = np.vstack([found.anchors[leg], found.feet[leg]])
    for k in reversed(range(len(KINDS))):  # a joint turns all points after it about its anchor
        s, c = np.sin(angles[k]), np.cos(angles[k])
        turn = [[1, 0, 0], [0, c, -s], [0, s, c]] if k == 0 else [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        points[k + 1 :] = points[k] + (points[k + 1 :] - points[k]) @ np.transpose(turn)
    return points
