"""`quadvel plot`: what was recorded of a run, as pictures of velocity, joints, torques and the controller's loop.

Of each topic what there is: a recording of a real robot knows no true velocity, one of the joints alone no velocity at all.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
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
from quadvel_recordings.joint_log import JointLog, read_joint_log
from quadvel_recordings.reading import RecordingError, read_messages
from quadvel_recordings.stamps import missing_stamp_notices, stamp_of

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
    """How a topic is read: the type of its messages, and their numbers."""

    typename: str
    numbers: Callable[[Any], Any]


KINDS: Mapping[str, _Kind] = {
    "/command": _Kind("quadvel_msgs/msg/VelocityCommand", lambda m: planar(m.twist)),
    "/velocity_estimate": _Kind(
        "geometry_msgs/msg/TwistWithCovarianceStamped", lambda m: planar(m.twist.twist)
    ),
    "/ground_truth/odom": _Kind("nav_msgs/msg/Odometry", lambda m: planar(m.twist.twist)),
    "/low_state": _Kind("quadvel_msgs/msg/LowState", _joints),
    "/low_cmd": _Kind("quadvel_msgs/msg/LowCmd", lambda m: list(m.q)),
    "/controller/state": _Kind(
        "quadvel_msgs/msg/ControllerState", lambda m: [getattr(m, name) for name in LOOP]
    ),
}


@attrs.frozen(eq=False)
class Run:
    """begin: s, on the clock of the stamps, of the first of all; lines: of each topic that was recorded, times (n,), s since then,
    and numbers (n, k); modes: the controller's in their order, each with its beginning, s; ends: s. joints: whose angles and then
    torques are the numbers of low_state. received: times of receipt count, as stamps are missing. foreign: what the lines of the
    joints are made of where they are no low_state of this stack.
    """

    begin: float
    lines: Mapping[str, tuple[Array, Array]]
    modes: list[tuple[float, str]]
    ends: float
    joints: Sequence[str] = JOINT_NAMES
    received: bool = False
    foreign: JointLog | None = None


@attrs.define
class _Topic:
    """Stamps and times of receipt, ns, and numbers of one topic."""

    stamps: list[int] = attrs.field(factory=list)
    receipts: list[int] = attrs.field(factory=list)
    numbers: list[list[float]] = attrs.field(factory=list)
    modes: list[str] = attrs.field(factory=list)

    def times(self, received: bool) -> Array:
        """s, on the clock that counts."""
        return np.asarray(1e-9 * np.array(self.receipts if received else self.stamps, np.int64), np.float64)


def read_run(
    path: Path,
    state_topic: str | None = None,
    command_topic: str | None = None,
    tell: Callable[[str], None] | None = None,
) -> Run:
    """What a recording holds, of this stack or of joints of any robot.

    Args:
        path: the recording.
        state_topic: topic of the joints' states, where it is not low_state.
        command_topic: topic of their commands, likewise.
        tell: called with a sentence for what had to be assumed.

    Raises:
        RecordingError: nothing that can be drawn was recorded; the sentence names the topics that are there.
    """
    rows = _read_topics(path, tell)
    missing = missing_stamp_notices({topic: np.array(found.stamps) for topic, found in rows.items()})
    if tell:
        for sentence in missing:
            tell(sentence)
    received = bool(missing)
    lines = {topic: (found.times(received), np.array(found.numbers, float)) for topic, found in rows.items()}
    foreign = None
    if "/low_state" not in rows or state_topic or command_topic:
        foreign = _foreign(path, state_topic, command_topic, tell, rows != {})
        lines |= _lines_of(foreign) if foreign else {}
    begin = min(float(times[0]) for times, _ in lines.values())
    lines = {topic: _thinned(times - begin, numbers) for topic, (times, numbers) in lines.items()}
    loop = rows.get("/controller/state", _Topic())
    changes = [k for k, mode in enumerate(loop.modes) if not k or loop.modes[k - 1] != mode]
    modes = [(float(loop.times(received)[k]) - begin, loop.modes[k]) for k in changes]
    ends = max(float(times[-1]) for times, _ in lines.values())
    joints = foreign.state.joints if foreign else JOINT_NAMES
    return Run(begin, lines, modes, ends, joints, received, foreign)


def _read_topics(path: Path, tell: Callable[[str], None] | None) -> dict[str, _Topic]:
    rows: dict[str, _Topic] = defaultdict(_Topic)
    known = {topic: kind.typename for topic, kind in KINDS.items()}
    for topic, receipt, message in read_messages(path, lambda topic, kind: known.get(topic) == kind, tell):
        rows[topic].stamps.append(stamp_of(message) or 0)
        rows[topic].receipts.append(receipt)
        rows[topic].numbers.append(KINDS[topic].numbers(message))
        if topic == "/controller/state":
            rows[topic].modes.append(message.mode_name)
    return dict(rows)


def _foreign(
    path: Path, state: str | None, command: str | None, tell: Callable[[str], None] | None, others: bool
) -> JointLog | None:
    """The joints of another robot, or None where other things can be drawn. Raises RecordingError."""
    try:
        return read_joint_log(path, state, command, tell)
    except RecordingError:
        if others and not (state or command):
            return None
        raise


def _lines_of(log: JointLog) -> dict[str, tuple[Array, Array]]:
    """Its lines as if they were low_state and low_cmd, of the joints that are measured; NaN for what is not there."""
    begin, joints = 1e-9 * log.start_ns, log.state.joints
    none = np.full((len(log.state.time), len(joints)), np.nan)
    numbers = np.hstack([log.state.values.get("q", none), log.state.values.get("tau", none)])
    lines = {"/low_state": (log.state.time + begin, numbers)}
    if log.command is not None and "q" in log.command.values:
        targets = np.full((len(log.command.time), len(joints)), np.nan)
        for k, joint in enumerate(joints):
            if joint in log.command.joints:
                targets[:, k] = log.command.values["q"][:, log.command.joints.index(joint)]
        lines["/low_cmd"] = log.command.time + begin, targets
    return lines


def _thinned(times: Array, numbers: Array) -> tuple[Array, Array]:
    """At most about POINTS of a line."""
    every = max(1, len(times) // POINTS)
    return times[::every], numbers[::every]


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
    figure, panels = panels_of_joints(run)
    for joint, (name, panel) in enumerate(zip(run.joints, panels.ravel(), strict=False)):
        if "/low_cmd" in run.lines:
            time, targets = run.lines["/low_cmd"]
            panel.plot(time, targets[:, joint], color="black", lw=0.6, label="target")
        time, numbers = run.lines["/low_state"]
        panel.plot(time, numbers[:, joint], color="tab:blue", lw=0.6, label="measured")
        panel.set_title(f"{name.removesuffix('_joint')}, rad", fontsize="small", loc="left")
    add_legend(figure, run, panels[0, 0])
    return figure


def torques_figure(run: Run) -> Figure | None:
    """Torque of each joint, of this stack's robot between its limits; None where none was measured."""
    time, numbers = run.lines.get("/low_state", (None, np.empty(0)))
    if np.isnan(numbers[..., len(run.joints) :]).all():
        return None
    figure, panels = panels_of_joints(run)
    for joint, (name, panel) in enumerate(zip(run.joints, panels.ravel(), strict=False)):
        panel.plot(time, numbers[:, len(run.joints) + joint], color="tab:blue", lw=0.6, label="measured")
        if run.foreign is None:
            panel.axhline(TORQUE_LIMIT[joint], color="tab:red", lw=0.8, ls="--", label="limit")
            panel.axhline(-TORQUE_LIMIT[joint], color="tab:red", lw=0.8, ls="--")
        panel.set_title(f"{name.removesuffix('_joint')}, N m", fontsize="small", loc="left")
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


def panels_of_joints(run: Run) -> tuple[Figure, Any]:
    """The same with a panel for each joint, three in a row as a leg has."""
    return panels_over(run, max(1, -(-len(run.joints) // 3)), 3, (13.0, max(3.0, 0.75 * len(run.joints))))


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


Recorded = Annotated[
    Path, typer.Argument(help="An MCAP file, a rosbag2 folder or a bag of ROS 1.", show_default=False)
]
StateTopic = Annotated[
    str | None, typer.Option(metavar="<topic>", help="States of the joints.", show_default="found by type")
]
CommandTopic = Annotated[
    str | None,
    typer.Option(metavar="<topic>", help="Commands of the joints.", show_default="found by type and name"),
]


def warn_of(recording: Path) -> Callable[[str], None]:
    """Print a sentence about a recording as a warning that names its file."""
    return lambda text: typer.echo(f"quadvel: warning: {recording}: {text}", err=True)


def plot_command(
    recording: Recorded,
    out: Annotated[Path, typer.Option(metavar="<folder>", help="Folder for the pictures.")] = Path(
        "out/plot"
    ),
    state_topic: StateTopic = None,
    command_topic: CommandTopic = None,
) -> None:
    """Draw what was recorded of a run: velocity, joints, torques, the controller's loop.

    Of another robot its joints: sensor_msgs/JointState, or unitree_go LowState and LowCmd. Colours show the controller's mode.
    """
    output_folder(out)
    run = read_run(recording, state_topic, command_topic, warn_of(recording))
    for name, draw in FIGURES.items():
        figure = draw(run)
        if figure is None:
            typer.echo(f"no {name}.png: nothing was recorded for it")
            continue
        with replacing(out / f"{name}.png") as draft:
            figure.savefig(draft, dpi=110)
        typer.echo(f"written: {out / name}.png")
