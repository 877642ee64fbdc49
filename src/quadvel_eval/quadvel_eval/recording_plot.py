"""Plots velocity, joints, torques and controller loop of a recording (`quadvel plot`).

Each plot appears only if its topics were recorded. A recording of a real robot has no true
velocity; a recording of joints alone has no velocity at all.
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

from quadvel_description.arrays import Array
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot, load_robot, robot_of_file
from quadvel_description.robot_name import described_robot
from quadvel_recordings.joint_log import JointLog, read_joint_log, robot_of_types
from quadvel_recordings.output import atomic_write, output_folder
from quadvel_recordings.reading import RecordingError, read_messages, recorded_description, topics
from quadvel_recordings.stamps import missing_stamp_notices, stamp_of

from .demo_figures import AXIS_LABELS
from .recording import planar

MAX_POINTS_PER_LINE = 4000  # more are invisible
LOOP_QUANTITIES = {
    "rate_hz": "rate, Hz",
    "compute_p99_us": "99th percentile of computing time, us",
    "overruns": "deadlines missed",
}
MODE_COLOURS = {
    "fault": "tab:red",
    "walk": "tab:green",
    "stance": "tab:blue",
    "stand_up": "tab:cyan",
    "lie_down": "tab:cyan",
}


def _joints(message: Any) -> list[float]:
    """Angles, then torques of a LowState."""
    return [*message.q, *message.tau]


@attrs.frozen
class _TopicReader:
    """How to read a topic: message type, and function from a message to numbers."""

    typename: str
    numbers: Callable[[Any], Any]


TOPIC_READERS: Mapping[str, _TopicReader] = {
    "/command": _TopicReader("quadvel_msgs/msg/VelocityCommand", lambda m: planar(m.twist)),
    "/velocity_estimate": _TopicReader(
        "geometry_msgs/msg/TwistWithCovarianceStamped", lambda m: planar(m.twist.twist)
    ),
    "/ground_truth/odom": _TopicReader("nav_msgs/msg/Odometry", lambda m: planar(m.twist.twist)),
    "/low_state": _TopicReader("quadvel_msgs/msg/LowState", _joints),
    "/low_cmd": _TopicReader("quadvel_msgs/msg/LowCmd", lambda m: list(m.q)),
    "/controller/state": _TopicReader(
        "quadvel_msgs/msg/ControllerState", lambda m: [getattr(m, name) for name in LOOP_QUANTITIES]
    ),
}


@attrs.frozen(eq=False)
class RecordedRun:
    """Series of a recorded run.

    Attributes:
        begin: First stamp of all topics, s.
        series: Times since `begin` (n,), s, and values (n, k) of each recorded topic.
        modes: Start (s) and name of each mode of the controller, in order.
        end: Last time of all topics, s since `begin`.
        robot: The robot: that asked for, else that of the recording, else an assumed one.
        joints: Joints of the series of low_state, which holds their angles, then their torques.
        uses_receipt_times: Whether times of receipt replace missing stamps.
        foreign_log: Joint log of another robot, if the joints come from one.
    """

    begin: float
    series: Mapping[str, tuple[Array, Array]]
    modes: list[tuple[float, str]]
    end: float
    robot: Robot
    joints: Sequence[str] = JOINT_NAMES
    uses_receipt_times: bool = False
    foreign_log: JointLog | None = None


@attrs.define
class _Topic:
    """Stamps and times of receipt (ns), and values of one topic."""

    stamps: list[int] = attrs.field(factory=list)
    receipts: list[int] = attrs.field(factory=list)
    numbers: list[list[float]] = attrs.field(factory=list)
    modes: list[str] = attrs.field(factory=list)

    def clock(self, received: bool) -> Array:
        """Return the times of the messages.

        Args:
            received: Whether to use times of receipt instead of stamps.

        Returns:
            Times (n,), s.
        """
        return np.asarray(1e-9 * np.array(self.receipts if received else self.stamps, np.int64), np.float64)


def read_recorded_run(
    path: Path,
    state_topic: str | None = None,
    command_topic: str | None = None,
    warn: Callable[[str], None] | None = None,
    asked: str | None = None,
) -> RecordedRun:
    """Read a recording of this stack, or of the joints of any robot.

    Args:
        path: The recording.
        state_topic: Topic of the joint states, if it is not low_state.
        command_topic: Topic of the joint commands, if it is not low_cmd.
        warn: Called with one sentence for each assumption.
        asked: Name or folder of the robot; None: that of the recording.

    Returns:
        The series of the run.

    Raises:
        RecordingError: The recording holds nothing to plot; the message names its topics.
    """
    if asked is not None:
        load_robot(asked)  # a wrong one is refused before the recording is read
    rows = _read_topics(path, warn)
    missing = missing_stamp_notices({topic: np.array(found.stamps) for topic, found in rows.items()})
    if warn:
        for sentence in missing:
            warn(sentence)
    received = bool(missing)
    lines = {topic: (found.clock(received), np.array(found.numbers, float)) for topic, found in rows.items()}
    foreign = None
    if "/low_state" not in rows or state_topic or command_topic:
        foreign = _read_foreign_log(path, state_topic, command_topic, warn, rows != {})
        lines |= _series_of_log(foreign) if foreign else {}
    begin = min(float(times[0]) for times, _ in lines.values())
    lines = {topic: _decimate(times - begin, numbers) for topic, (times, numbers) in lines.items()}
    loop = rows.get("/controller/state", _Topic())
    changes = [k for k, mode in enumerate(loop.modes) if not k or loop.modes[k - 1] != mode]
    modes = [(float(loop.clock(received)[k]) - begin, loop.modes[k]) for k in changes]
    ends = max(float(times[-1]) for times, _ in lines.values())
    joints = foreign.state.joints if foreign else JOINT_NAMES
    likely = robot_of_types(topics(path).values())
    notify = warn if foreign and set(joints) & set(JOINT_NAMES) else None
    robot = robot_of_file(path, described_robot(recorded_description(path)), asked, likely, notify)
    return RecordedRun(begin, lines, modes, ends, robot, joints, received, foreign)


def _read_topics(path: Path, warn: Callable[[str], None] | None) -> dict[str, _Topic]:
    """Read stamps and values of all topics of TOPIC_READERS."""
    rows: dict[str, _Topic] = defaultdict(_Topic)
    known = {topic: kind.typename for topic, kind in TOPIC_READERS.items()}
    for topic, receipt, message in read_messages(path, lambda topic, kind: known.get(topic) == kind, warn):
        rows[topic].stamps.append(stamp_of(message) or 0)
        rows[topic].receipts.append(receipt)
        rows[topic].numbers.append(TOPIC_READERS[topic].numbers(message))
        if topic == "/controller/state":
            rows[topic].modes.append(message.mode_name)
    return dict(rows)


def _read_foreign_log(
    path: Path, state: str | None, command: str | None, warn: Callable[[str], None] | None, others: bool
) -> JointLog | None:
    """Joint log of another robot; None if there are other series to plot. Raises RecordingError."""
    try:
        return read_joint_log(path, state, command, warn)
    except RecordingError:
        if others and not (state or command):
            return None
        raise


def _series_of_log(log: JointLog) -> dict[str, tuple[Array, Array]]:
    """Series of a joint log under the names low_state and low_cmd, with NaN for missing values."""
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


def _decimate(times: Array, numbers: Array) -> tuple[Array, Array]:
    """Keep at most about MAX_POINTS_PER_LINE points of a series."""
    every = max(1, len(times) // MAX_POINTS_PER_LINE)
    return times[::every], numbers[::every]


def velocity_figure(run: RecordedRun) -> Figure | None:
    """Plot commanded, estimated and true velocity, as far as recorded.

    Args:
        run: The run.

    Returns:
        Figure; None if no velocity was recorded.
    """
    names = {"/command": ("commanded", "black"), "/velocity_estimate": ("estimated", "tab:orange")}
    names["/ground_truth/odom"] = ("true", "tab:blue")
    there = [topic for topic in names if topic in run.series]
    if not there:
        return None
    figure, panels = time_panels(run, 3, 1, (11.0, 7.0))
    for axis, panel in enumerate(panels[:, 0]):
        for topic in reversed(there):
            label, colour = names[topic]
            time, value = run.series[topic]
            panel.plot(time, value[:, axis], color=colour, lw=0.8, label=label)
        panel.set_ylabel(AXIS_LABELS[axis])
    add_legend(figure, run, panels[0, 0])
    return figure


def joints_figure(run: RecordedRun) -> Figure | None:
    """Plot measured angle and target of each joint.

    Args:
        run: The run.

    Returns:
        Figure; None without low_state.
    """
    if "/low_state" not in run.series:
        return None
    figure, panels = joint_panels(run)
    for joint, (name, panel) in enumerate(zip(run.joints, panels.ravel(), strict=False)):
        if "/low_cmd" in run.series:
            time, targets = run.series["/low_cmd"]
            panel.plot(time, targets[:, joint], color="black", lw=0.6, label="target")
        time, numbers = run.series["/low_state"]
        panel.plot(time, numbers[:, joint], color="tab:blue", lw=0.6, label="measured")
        panel.set_title(f"{name.removesuffix('_joint')}, rad", fontsize="small", loc="left")
    add_legend(figure, run, panels[0, 0])
    return figure


def torques_figure(run: RecordedRun) -> Figure | None:
    """Plot the torque of each joint, with the limits of the robot's own joints.

    Args:
        run: The run.

    Returns:
        Figure; None if no torque was measured.
    """
    time, numbers = run.series.get("/low_state", (None, np.empty(0)))
    if np.isnan(numbers[..., len(run.joints) :]).all():
        return None
    figure, panels = joint_panels(run)
    for joint, (name, panel) in enumerate(zip(run.joints, panels.ravel(), strict=False)):
        panel.plot(time, numbers[:, len(run.joints) + joint], color="tab:blue", lw=0.6, label="measured")
        if name in JOINT_NAMES:
            limit = run.robot.torque_limit[JOINT_NAMES.index(name)]
            panel.axhline(limit, color="tab:red", lw=0.8, ls="--", label="limit")
            panel.axhline(-limit, color="tab:red", lw=0.8, ls="--")
        panel.set_title(f"{name.removesuffix('_joint')}, N m", fontsize="small", loc="left")
    add_legend(figure, run, panels[0, 0])
    return figure


def loop_figure(run: RecordedRun) -> Figure | None:
    """Plot rate, computing time and missed deadlines of the controller.

    Args:
        run: The run.

    Returns:
        Figure; None if the controller's state was not recorded.
    """
    if "/controller/state" not in run.series:
        return None
    figure, panels = time_panels(run, len(LOOP_QUANTITIES), 1, (11.0, 6.0))
    time, numbers = run.series["/controller/state"]
    for column, (panel, name) in enumerate(zip(panels[:, 0], LOOP_QUANTITIES.values(), strict=True)):
        panel.plot(time, numbers[:, column], color="tab:blue", lw=1.0)
        panel.set_ylabel(name)
    add_legend(figure, run, panels[0, 0])
    return figure


FIGURES: Mapping[str, Callable[[RecordedRun], Figure | None]] = {
    "velocity": velocity_figure,
    "joints": joints_figure,
    "torques": torques_figure,
    "loop": loop_figure,
}


def time_panels(run: RecordedRun, rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, Any]:
    """Create a figure with panels over the time of a run, shaded by the controller's mode.

    Args:
        run: The run.
        rows: Rows of panels.
        columns: Columns of panels.
        size: Width and height, inches.

    Returns:
        Figure and panels (rows, columns).
    """
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for panel in panels.ravel():
        panel.grid(alpha=0.3)
        panel.set_xlim(0.0, max(run.end, 1e-3))
        for (begin, mode), (end, _) in pairwise([*run.modes, (run.end, "")]):
            panel.axvspan(begin, end, color=_mode_colour(mode), alpha=0.08, lw=0.0)
    for panel in panels[-1]:
        panel.set_xlabel("time, s")
    return figure, panels


def joint_panels(run: RecordedRun) -> tuple[Figure, Any]:
    """Create a figure with one panel per joint, three per row, one row per leg.

    Args:
        run: The run.

    Returns:
        Figure and panels (rows, 3).
    """
    return time_panels(run, max(1, -(-len(run.joints) // 3)), 3, (13.0, max(3.0, 0.75 * len(run.joints))))


def add_legend(figure: Figure, run: RecordedRun, panel: Any) -> None:
    """Add a legend of lines and mode colours above the panels.

    Args:
        figure: The figure.
        run: The run, for its modes.
        panel: Panel whose lines the legend explains.
    """
    lines = panel.get_legend_handles_labels()[0]
    modes = dict.fromkeys(mode for _, mode in run.modes)
    shades = [Patch(color=_mode_colour(mode), alpha=0.3, label=mode.replace("_", " ")) for mode in modes]
    figure.legend(
        handles=[*lines, *shades], loc="outside upper left", ncols=len(lines) + len(shades), frameon=False
    )


def _mode_colour(mode: str) -> str:
    """Colour of a mode."""
    return MODE_COLOURS.get(mode, "grey")


RecordingArgument = Annotated[
    Path, typer.Argument(help="An MCAP file, a rosbag2 folder or a bag of ROS 1.", show_default=False)
]
RobotOption = Annotated[
    str | None,
    typer.Option(
        metavar="<name|file>",
        help="The robot: aliengo, go2, or a robot.yaml or its folder.",
        show_default="as recorded, or aliengo",
    ),
]
StateTopicOption = Annotated[
    str | None,
    typer.Option(metavar="<topic>", help="Topic of the joint states.", show_default="found by type"),
]
CommandTopicOption = Annotated[
    str | None,
    typer.Option(
        metavar="<topic>", help="Topic of the joint commands.", show_default="found by type and name"
    ),
]


def warning_printer(recording: Path) -> Callable[[str], None]:
    """Return a function that prints a warning with the name of a recording.

    Args:
        recording: The recording.

    Returns:
        Function of one sentence.
    """
    return lambda text: typer.echo(f"quadvel: warning: {recording}: {text}", err=True)


def plot_command(
    recording: RecordingArgument,
    out: Annotated[Path, typer.Option(metavar="<folder>", help="Folder for the pictures.")] = Path(
        "out/plot"
    ),
    robot: RobotOption = None,
    state_topic: StateTopicOption = None,
    command_topic: CommandTopicOption = None,
) -> None:
    """Draw a recorded run: velocity, joints, torques and controller loop.

    For another robot it draws the joints: sensor_msgs/JointState, or unitree_go LowState and
    LowCmd. Colours show the controller's mode.
    """
    output_folder(out)
    run = read_recorded_run(recording, state_topic, command_topic, warning_printer(recording), robot)
    for name, draw in FIGURES.items():
        figure = draw(run)
        if figure is None:
            typer.echo(f"no {name}.png: its topics were not recorded")
            (out / f"{name}.png").unlink(missing_ok=True)  # of another recording
            continue
        with atomic_write(out / f"{name}.png") as draft:
            figure.savefig(draft, dpi=110)
        typer.echo(f"written: {out / name}.png")
