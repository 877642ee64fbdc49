"""`quadvel replay`: a recording through the actuator model and the velocity estimator, offline. What would they have said?"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import attrs
import numpy as np
import typer
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from quadvel_actuator import ActuatorParameters
from quadvel_description.robot import JOINT_NAMES
from quadvel_estimator.features import previous_action
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_estimator.learned import SHIPPED_MODEL, LearnedEstimator
from quadvel_estimator.tracker import Estimator, VelocityTracker
from quadvel_nodes.messages import MessageError, read_low_state
from quadvel_nodes.number_text import number_text
from quadvel_nodes.stall_free_clock import StallFreeClock
from quadvel_recordings.reading import RecordingError, read_messages

from .demo_figures import AXES
from .output import output_folder, replacing
from .recording_plot import (
    CommandTopic,
    Recorded,
    Run,
    StateTopic,
    add_legend,
    panels_over,
    read_run,
    warn_of,
)
from .replay import PAST, Joints, joints_of, modelled_torque, read_joints
from .segments import rounded

Array = NDArray[np.float64]

SLOWEST = 0.005  # s, from one state to the next
MEMORY = 0.5
"""s from the beginning of a recording in which an estimator still lacks what it would remember of the time before"""


@attrs.frozen(eq=False)
class Torques:
    """What the drives measured and what the model says, (n, 12) N m, at `time` (n,) s, where states and their past are whole."""

    time: Array
    measured: Array
    modelled: Array

    @property
    def errors(self) -> Array:
        """RMS of measured minus modelled, (12,) N m."""
        found: Array = np.sqrt(np.mean((self.measured - self.modelled) ** 2, axis=0))
        return found


def torques(joints: Joints, actuator: ActuatorParameters) -> Torques:
    """Raises ValueError where no row of the recording has its past."""
    modelled = modelled_torque(actuator, joints, 0, len(joints.time))
    rows = joints.seen.copy()
    rows[:PAST] = False
    if not rows.any():
        raise ValueError(f"joints: found {len(rows)} ms of states, expected more than {PAST}")
    return Torques(joints.time[rows], joints.tau[rows], modelled[rows])


def estimated(path: Path, estimator: Estimator, received: bool = False) -> tuple[Array, Array]:
    """What `estimator` says of the recorded states and commands: times (n,), s, and velocities (n, 3), m/s, body frame.

    States that it can't use are left out; with `received` the times of receipt count. Raises RecordingError where none can be used.
    """
    tracker, clock = VelocityTracker(estimator), StallFreeClock()
    times, found = [], []
    topics = ("/low_state", "/low_cmd")
    for topic, receipt, message in read_messages(path, lambda topic, _: topic in topics, lambda _: None):
        if topic == "/low_cmd":
            tracker.set_previous_action(previous_action(np.asarray(message.q, float), message.mode))
            continue
        try:
            state = read_low_state(message)
            state.time = 1e-9 * receipt if received else state.time
            stamp, state.time = state.time, clock.update(state.time, state.tick)
            estimate = tracker.process(state)
        except (MessageError, FloatingPointError):
            continue
        if estimate is not None:
            times.append(stamp)
            found.append(estimate.velocity)
    if not times:
        raise RecordingError(f"{path}: low_state: found no state that an estimator can use")
    return np.array(times), np.array(found)


def velocity_errors(run: Run, times: Array, found: Array) -> Mapping[str, Array]:
    """RMS (2,) of vx and vy, m/s: of the velocities found minus what the robot's own estimator said, and minus the true ones, where
    these were recorded. The first MEMORY of a longer recording is left out.
    """
    errors = {}
    whole = np.searchsorted(times, times[0] + MEMORY) % len(times)  # 0: all of a short one
    times, found = times[whole:], found[whole:]
    for name, topic in (("recorded estimate", "/velocity_estimate"), ("truth", "/ground_truth/odom")):
        if topic in run.lines:
            time, value = run.lines[topic]
            then = np.column_stack([np.interp(times - run.begin, time, axis) for axis in value.T])
            errors[name] = np.sqrt(np.mean((found[:, :2] - then[:, :2]) ** 2, axis=0))
    return errors


def torque_figure(run: Run, said: Torques) -> Figure:
    """Measured and modelled torque of each joint."""
    figure, panels = panels_over(run, 4, 3, (13.0, 9.0))
    for joint, panel in enumerate(panels.ravel()):
        for label, value, colour in (
            ("measured", said.measured, "black"),
            ("modelled", said.modelled, "tab:blue"),
        ):
            panel.plot(said.time - run.begin, value[:, joint], color=colour, lw=0.5, label=label)
        name = JOINT_NAMES[joint].removesuffix("_joint")
        panel.set_title(f"{name}, N m: off by {said.errors[joint]:.2f}", fontsize="small", loc="left")
    add_legend(figure, run, panels[0, 0])
    return figure


def velocity_figure(run: Run, times: Array, found: Array) -> Figure:
    """Velocities found offline over those that were recorded."""
    figure, panels = panels_over(run, 2, 1, (11.0, 5.0))
    recorded = {
        "/ground_truth/odom": ("true", "tab:blue"),
        "/velocity_estimate": ("recorded estimate", "tab:orange"),
    }
    for axis, panel in enumerate(panels[:, 0]):
        for topic, (label, colour) in recorded.items():
            if topic in run.lines:
                panel.plot(
                    run.lines[topic][0], run.lines[topic][1][:, axis], color=colour, lw=0.8, label=label
                )
        panel.plot(times - run.begin, found[:, axis], color="black", lw=0.8, label="offline")
        panel.set_ylabel(AXES[axis])
    add_legend(figure, run, panels[0, 0])
    return figure


def replay_command(
    recording: Recorded,
    out: Annotated[
        Path, typer.Option(metavar="<folder>", help="Folder for replay.json and pictures.")
    ] = Path("out/replay"),
    actuator: Annotated[
        Path | None, typer.Option(metavar="<file>", help="An actuator.yaml.", show_default="the shipped one")
    ] = None,
    estimator: Annotated[
        Literal["learned", "kalman"], typer.Option(help="Which estimator of the velocity.")
    ] = "learned",
    estimator_file: Annotated[
        Path,
        typer.Option(metavar="<file>", help="ONNX file of the learned one.", show_default="the shipped one"),
    ] = SHIPPED_MODEL,
    gains: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="<kp kd>",
            help="Commanded gains, N m/rad and N m s/rad, of recordings that hold none.",
            show_default="none",
        ),
    ] = None,
    state_topic: StateTopic = None,
    command_topic: CommandTopic = None,
) -> None:
    """Ask the actuator model and the estimator offline what they say of a recording of low_state and low_cmd.

    Of another robot's recording (sensor_msgs/JointState, unitree_go) the actuator model alone is asked.

    \b
    For example, whether a corrected model says more of a walk than the shipped one:
      quadvel replay walk.mcap --actuator out/identify/actuator.yaml
    To see a recording in 3-D: quadvel view walk.mcap
    """
    model = ActuatorParameters.default() if actuator is None else ActuatorParameters.load(actuator)
    asked = LearnedEstimator(estimator_file) if estimator == "learned" else KalmanEstimator()
    output_folder(out)
    run = read_run(recording, state_topic, command_topic, warn_of(recording))
    if run.foreign is None:
        joints = read_joints(recording, SLOWEST, run.received)
    else:
        joints = joints_of(recording, run.foreign, SLOWEST, gains)
    said = torques(joints, model)
    pictures, errors = {"torque": torque_figure(run, said)}, dict[str, Array]()
    if run.foreign is None:
        times, found = estimated(recording, asked, run.received)
        errors |= velocity_errors(run, times, found)
        pictures["velocity"] = velocity_figure(run, times, found)
    _show(said, errors)
    _write(out, said, errors, pictures)


def _write(out: Path, said: Torques, errors: Mapping[str, Array], pictures: Mapping[str, Figure]) -> None:
    """replay.json and the pictures."""
    result: dict[str, Any] = {
        "schema": 1,
        "torque_rms_nm": dict(
            zip(JOINT_NAMES, map(rounded, np.sqrt((said.measured**2).mean(0)).tolist()), strict=True)
        ),
        "torque_error_nm": dict(zip(JOINT_NAMES, map(rounded, said.errors.tolist()), strict=True)),
        "velocity_error": {name: [rounded(one) for one in error.tolist()] for name, error in errors.items()},
    }
    with replacing(out / "replay.json") as draft:
        draft.write_text(json.dumps(result, indent=1))
    for name, figure in pictures.items():
        with replacing(out / f"{name}.png") as draft:
            figure.savefig(draft, dpi=110)
    typer.echo(f"written: {out}/replay.json, {', '.join(f'{name}.png' for name in pictures)}")


def _show(said: Torques, errors: Mapping[str, Array]) -> None:
    table = Table("torque, RMS in N m", "measured", "off by", title="actuator model on the recorded motion")
    for joint, name in enumerate(JOINT_NAMES):
        rms = np.sqrt(np.mean(said.measured[:, joint] ** 2))
        table.add_row(
            name.removesuffix("_joint"), number_text(rms, ".2f"), number_text(said.errors[joint], ".2f")
        )
    Console().print(table)
    for name, (x, y) in errors.items():
        typer.echo(
            f"estimator, offline, beside the {name}: RMS {number_text(x, '.3f')} m/s in vx, {number_text(y, '.3f')} in vy"
        )
