"""Runs actuator model and velocity estimator offline on a recording (`quadvel replay`).

`replay` reads the joints and evaluates the actuator model; `recording_plot` draws what was
recorded. Nothing is fitted: `quadvel identify` does that.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import attrs
import numpy as np
import typer
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from quadvel_actuator import ActuatorParameters
from quadvel_description.arrays import Array
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_estimator.learned import LearnedEstimator
from quadvel_estimator.tracker import Estimator, VelocityTracker
from quadvel_nodes.messages import MessageError, read_low_state
from quadvel_nodes.number_text import number_text
from quadvel_nodes.stall_free_clock import StallFreeClock
from quadvel_recordings.output import atomic_write, output_folder
from quadvel_recordings.reading import RecordingError, read_messages, warn_of_unused_gains

from .demo_figures import AXIS_LABELS
from .recording_plot import (
    CommandTopicOption,
    RecordedRun,
    RecordingArgument,
    RobotOption,
    StateTopicOption,
    add_legend,
    read_recorded_run,
    time_panels,
    warning_printer,
)
from .replay import HISTORY_MS, JointRecord, joints_from_log, modelled_torque, read_joints
from .segments import rounded

MAX_STATE_PERIOD_S = 0.005
WARM_UP_S = 0.5
"""Start of a recording in which an estimator still lacks its history."""


@attrs.frozen(eq=False)
class TorqueComparison:
    """Measured and modelled torques where states and their history are complete.

    Attributes:
        time: Times (n,), s.
        measured: Measured torques (n, 12), N m.
        modelled: Torques of the actuator model (n, 12), N m.
    """

    time: Array
    measured: Array
    modelled: Array

    @property
    def errors(self) -> Array:
        """RMS of measured minus modelled torque (12,), N m."""
        found: Array = np.sqrt(np.mean((self.measured - self.modelled) ** 2, axis=0))
        return found


def compare_torques(joints: JointRecord, actuator: ActuatorParameters) -> TorqueComparison:
    """Compare measured torques with those of an actuator model.

    Args:
        joints: The recorded joints.
        actuator: Parameters of the model.

    Returns:
        The comparison.

    Raises:
        ValueError: The recording is shorter than the history of the model.
    """
    modelled = modelled_torque(actuator, joints, 0, len(joints.time))
    rows = joints.recorded.copy()
    rows[:HISTORY_MS] = False
    if not rows.any():
        raise ValueError(f"joints: found {len(rows)} ms of states, expected more than {HISTORY_MS}")
    return TorqueComparison(joints.time[rows], joints.tau[rows], modelled[rows])


def run_estimator(
    robot: Robot, path: Path, estimator: Estimator, use_receipt_times: bool = False
) -> tuple[Array, Array]:
    """Run a velocity estimator on recorded states and commands; unusable states are skipped.

    Args:
        robot: The robot.
        path: The recording.
        estimator: The estimator.
        use_receipt_times: Whether to use times of receipt instead of stamps.

    Returns:
        Times (n,), s, and velocities (n, 3), m/s, body frame.

    Raises:
        RecordingError: No state is usable.
    """
    tracker, clock = VelocityTracker(estimator), StallFreeClock()
    times, found = [], []
    topics = ("/low_state", "/low_cmd")
    for topic, receipt, message in read_messages(path, lambda topic, _: topic in topics, lambda _: None):
        if topic == "/low_cmd":
            tracker.set_command(robot, np.asarray(message.q, float), message.mode)
            continue
        try:
            state = read_low_state(message)
            state.time = 1e-9 * receipt if use_receipt_times else state.time
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


def velocity_errors(run: RecordedRun, times: Array, found: Array) -> Mapping[str, Array]:
    """Compare offline velocities with the recorded estimate and the truth, as far as recorded.

    The first WARM_UP_S of a longer recording is left out.

    Args:
        run: The recorded run.
        times: Times of the offline velocities (n,), s.
        found: Offline velocities (n, 3), m/s.

    Returns:
        RMS differences of vx and vy (2,), m/s, by reference.
    """
    errors = {}
    whole = np.searchsorted(times, times[0] + WARM_UP_S) % len(times)  # 0: keep all of a short recording
    times, found = times[whole:], found[whole:]
    for name, topic in (("recorded estimate", "/velocity_estimate"), ("truth", "/ground_truth/odom")):
        if topic in run.series:
            time, value = run.series[topic]
            then = np.column_stack([np.interp(times - run.begin, time, axis) for axis in value.T])
            errors[name] = np.sqrt(np.mean((found[:, :2] - then[:, :2]) ** 2, axis=0))
    return errors


def torque_figure(run: RecordedRun, comparison: TorqueComparison) -> Figure:
    """Plot measured and modelled torque of each joint.

    Args:
        run: The recorded run.
        comparison: The comparison.

    Returns:
        The figure.
    """
    figure, panels = time_panels(run, 4, 3, (13.0, 9.0))
    for joint, panel in enumerate(panels.ravel()):
        for label, value, colour in (
            ("measured", comparison.measured, "black"),
            ("modelled", comparison.modelled, "tab:blue"),
        ):
            panel.plot(comparison.time - run.begin, value[:, joint], color=colour, lw=0.5, label=label)
        name = JOINT_NAMES[joint].removesuffix("_joint")
        panel.set_title(f"{name}, N m: off by {comparison.errors[joint]:.2f}", fontsize="small", loc="left")
    add_legend(figure, run, panels[0, 0])
    return figure


def velocity_figure(run: RecordedRun, times: Array, found: Array) -> Figure:
    """Plot offline and recorded velocities.

    Args:
        run: The recorded run.
        times: Times of the offline velocities (n,), s.
        found: Offline velocities (n, 3), m/s.

    Returns:
        The figure.
    """
    figure, panels = time_panels(run, 2, 1, (11.0, 5.0))
    recorded = {
        "/ground_truth/odom": ("true", "tab:blue"),
        "/velocity_estimate": ("recorded estimate", "tab:orange"),
    }
    for axis, panel in enumerate(panels[:, 0]):
        for topic, (label, colour) in recorded.items():
            if topic in run.series:
                panel.plot(
                    run.series[topic][0], run.series[topic][1][:, axis], color=colour, lw=0.8, label=label
                )
        panel.plot(times - run.begin, found[:, axis], color="black", lw=0.8, label="offline")
        panel.set_ylabel(AXIS_LABELS[axis])
    add_legend(figure, run, panels[0, 0])
    return figure


def replay_command(
    recording: RecordingArgument,
    out: Annotated[
        Path, typer.Option(metavar="<folder>", help="Folder for replay.json and pictures.")
    ] = Path("out/replay"),
    actuator: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="Actuator model, an actuator.yaml.", show_default="the shipped one"
        ),
    ] = None,
    estimator: Annotated[Literal["learned", "kalman"], typer.Option(help="Velocity estimator.")] = "learned",
    estimator_file: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="ONNX file of the learned estimator.", show_default="the shipped one"
        ),
    ] = None,
    gains: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="<kp kd>",
            help="Commanded gains, N m/rad and N m s/rad, if the recording holds none.",
            show_default="none",
        ),
    ] = None,
    robot: RobotOption = None,
    state_topic: StateTopicOption = None,
    command_topic: CommandTopicOption = None,
) -> None:
    """Run actuator model and velocity estimator offline on a recording of low_state and low_cmd.

    For another robot (sensor_msgs/JointState, unitree_go) only the actuator model runs.

    \b
    For example, to compare a corrected actuator model with the shipped one:
      quadvel replay walk.mcap --actuator out/identify/actuator.yaml
    To see a recording in 3-D: quadvel view walk.mcap
    """
    output_folder(out)
    if estimator != "learned" and estimator_file is not None:
        raise ValueError(
            f"--estimator-file: found {estimator_file} with --estimator {estimator}, expected learned"
        )
    run = read_recorded_run(recording, state_topic, command_topic, warning_printer(recording), robot)
    chosen = run.robot
    model = ActuatorParameters.of(chosen) if actuator is None else ActuatorParameters.load(chosen, actuator)
    asked = LearnedEstimator(chosen, estimator_file) if estimator == "learned" else KalmanEstimator(chosen)
    if run.foreign_log is None:
        if gains is not None:
            warn_of_unused_gains(recording)
        joints = read_joints(recording, MAX_STATE_PERIOD_S, run.uses_receipt_times)
    else:
        joints = joints_from_log(recording, run.foreign_log, MAX_STATE_PERIOD_S, gains)
    comparison = compare_torques(joints, model)
    pictures, errors = {"torque": torque_figure(run, comparison)}, dict[str, Array]()
    if run.foreign_log is None:
        times, found = run_estimator(chosen, recording, asked, run.uses_receipt_times)
        errors |= velocity_errors(run, times, found)
        pictures["velocity"] = velocity_figure(run, times, found)
    _print_results(comparison, errors)
    _write(out, comparison, errors, pictures)


def _write(
    out: Path, comparison: TorqueComparison, errors: Mapping[str, Array], pictures: Mapping[str, Figure]
) -> None:
    """Write replay.json and the pictures."""
    result: dict[str, Any] = {
        "schema": 1,
        "torque_rms_nm": dict(
            zip(JOINT_NAMES, map(rounded, np.sqrt((comparison.measured**2).mean(0)).tolist()), strict=True)
        ),
        "torque_error_nm": dict(zip(JOINT_NAMES, map(rounded, comparison.errors.tolist()), strict=True)),
        "velocity_error": {name: [rounded(one) for one in error.tolist()] for name, error in errors.items()},
    }
    with atomic_write(out / "replay.json") as draft:
        draft.write_text(json.dumps(result, indent=1))
    for name, figure in pictures.items():
        with atomic_write(out / f"{name}.png") as draft:
            figure.savefig(draft, dpi=110)
    typer.echo(f"written: {out}/replay.json, {', '.join(f'{name}.png' for name in pictures)}")


def _print_results(comparison: TorqueComparison, errors: Mapping[str, Array]) -> None:
    """Print torque and velocity errors."""
    table = Table("torque, RMS in N m", "measured", "off by", title="actuator model on the recorded motion")
    for joint, name in enumerate(JOINT_NAMES):
        rms = np.sqrt(np.mean(comparison.measured[:, joint] ** 2))
        table.add_row(
            name.removesuffix("_joint"), number_text(rms, ".2f"), number_text(comparison.errors[joint], ".2f")
        )
    Console(markup=False).print(table)
    for name, (x, y) in errors.items():
        typer.echo(
            f"offline estimator minus {name}: RMS {number_text(x, '.3f')} m/s in vx, {number_text(y, '.3f')} in vy"
        )
