"""Defines the command `quadvel why` for Typer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from quadvel_eval.recording_plot import CommandTopicOption, RobotOption, StateTopicOption
from quadvel_policy.imported.policy import ImportedPolicy
from quadvel_policy.policy_file import chosen_policy
from quadvel_recordings.output import atomic_write, output_folder
from quadvel_sysid.logs.readers.columns import ColumnMap
from quadvel_sysid.logs.readers.recordings import Topics

from .diagnosis import diagnose
from .reading import read_run
from .report import picture, summary, to_json
from .run import Run
from .signals import Signals


def why_command(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings (MCAP, rosbag2, ROS 1), or tables of joints as `quadvel identify` reads them.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="<folder>",
            help="Folder for why.json and why.png; of several recordings, for a folder each.",
        ),
    ] = Path("out/why"),
    policy: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>",
            help="ONNX file of the policy that drove, or none.",
            show_default="the shipped one, for a recording of this stack",
        ),
    ] = None,
    robot: RobotOption = None,
    gains: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="<kp kd>",
            help="Commanded gains, N m/rad and N m s/rad, if the recording holds none.",
            show_default="none",
        ),
    ] = None,
    columns: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>",
            help="YAML file that maps the names of a table to fields, as for `quadvel identify`.",
            show_default="names as in docs/identification.md",
        ),
    ] = None,
    state_topic: StateTopicOption = None,
    command_topic: CommandTopicOption = None,
) -> None:
    """Find out why a recorded run failed: the first link of the chain that breaks.

    The chain is contract, timing, sensors, estimator, drives, ground, task. Each cause is tested against
    physics that it cannot fake: torque against the PD law of the commands, angles against speeds,
    orientation against gyroscope and gravity, planted feet against the trunk, and the recorded actions
    against the policy, replayed on what was recorded. The answer names one cause, with numbers, a
    picture of the time in which it shows, and what to do. docs/why.md lists all causes.

    \b
    For example, record until the robot falls, then ask:
      quadvel record --out fall.mcap
      quadvel why fall.mcap
    several faults that `quadvel record --ring` has recorded:
      quadvel why out/faults/first.mcap out/faults/second.mcap
    with a policy of your own, or the log of another robot:
      quadvel why fall.mcap --policy mine.onnx
      quadvel why walk.npz --gains 35 0.5

    \b
    Exit codes:
      0  every link holds, as far as the recording shows
      1  a link breaks; it is named
      2  a wrong argument or file
    """
    names = None if columns is None else ColumnMap.load(columns)
    folders = [out if len(recordings) == 1 else out / recording.stem for recording in recordings]
    if len({*folders}) < len(folders):
        raise typer.BadParameter("recordings of one name would have one folder; ask about each alone")
    broken = False
    for recording, folder in zip(recordings, folders, strict=True):
        output_folder(folder)
        if len(recordings) > 1:
            typer.echo(f"{recording}:")
        run = read_run(recording, gains, robot, names, Topics(state_topic, command_topic))
        broken |= _answer(run, recording, policy, folder)
    if broken:
        raise typer.Exit(1)


def _answer(run: Run, recording: Path, policy: Path | None, out: Path) -> bool:
    """Print and write the diagnosis of a run.

    Args:
        run: What was recorded.
        recording: Its file, for warnings.
        policy: ONNX file of the policy that drove; None: the shipped one.
        out: Folder for why.json and why.png.

    Returns:
        Whether a link breaks.
    """
    try:
        driver = chosen_policy(run.robot, str(policy or "")) if policy is not None or run.is_own else None
    except FileNotFoundError as error:
        if policy is not None:
            raise
        hint = "name the policy that drove by --policy FILE, or none"
        raise FileNotFoundError(
            f"{recording}: no policy is shipped for its robot {run.robot.name!r}: {hint}"
        ) from error
    for remark in run.remarks:
        typer.echo(f"quadvel: warning: {recording}: {remark}", err=True)
    if isinstance(driver, ImportedPolicy):
        typer.echo(
            f"quadvel: warning: {policy}: is of another project, so it is not replayed on the recording",
            err=True,
        )
        driver = None
    diagnosis = diagnose(Signals(run, driver))
    typer.echo(summary(run, diagnosis))
    with atomic_write(out / "why.json") as draft:
        draft.write_text(json.dumps(to_json(run, diagnosis), indent=1))
    written = ["why.json"]
    if diagnosis.finding is not None and diagnosis.finding.measurement.traces:
        with atomic_write(out / "why.png") as draft:
            picture(diagnosis.finding).savefig(draft, dpi=110, format="png")
        written.append("why.png")
    else:
        (out / "why.png").unlink(missing_ok=True)  # of another recording
    typer.echo(f"written: {out}/{', '.join(written)}")
    return diagnosis.finding is not None
