"""`quadvel twin`: benchmark of the identification against plants with known hidden effects.

A plant with an effect that the stack's model lacks walks with the shipped policy, as processes over
DDS. `quadvel identify` gets the recording only. The corrected model replaces the stack's own in
simulation, and its predictions are compared with the plant. Only the plant's process reads the
plant's file.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import attrs
import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from quadvel_actuator import ActuatorParameters
from quadvel_bringup.processes import ProcessGroup, StopSignals
from quadvel_bringup.stack import Stack
from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_eval import demo_summary, replay
from quadvel_eval.pool import Call, run_in_parallel
from quadvel_eval.recording import Recording, read_recording
from quadvel_eval.report import read_json, write_json
from quadvel_eval.script import SCRIPTS, Drive
from quadvel_eval.segments import Segment, rounded
from quadvel_recordings.output import atomic_write, output_folder

from .ground_truth_page import ROWS, summary_sentence, twin_page
from .plant import read_plant
from .recorded_run import POLL_PERIOD_S
from .scripted_walk import ScriptedWalk

PLANTS = Path(__file__).parent / "config" / "plants"
SHIPPED = ("dry_gears", "slow_current", "chafing_cable")
SCRIPT = "circuit"
WALKS = ("walk_1", "walk_2")
"""The first walk is fitted, the second one is held out; they differ in the seed of the noise."""
MODEL_SEEDS = (0, 1)
"""Seeds of the model's walks."""
SCHEMA = 1


def twin_command(
    plants: Annotated[
        list[str] | None,
        typer.Argument(help=f"Shipped plants ({', '.join(SHIPPED)}) or YAML files.", show_default="all"),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="<folder>", help="Folder for the results.")] = Path("out/twin"),
    reuse: Annotated[bool, typer.Option("--reuse", help="Reuse existing recordings and reports.")] = False,
) -> None:
    """Benchmark the identification on plants with hidden effects.

    Each plant walks a circuit twice, as processes over DDS; `quadvel identify` gets the recordings
    only. OUT/twin.html shows what was identified in each plant, and the error of the model before
    and after.

    \b
    For example:
      quadvel twin dry_gears --out out/twin
      quadvel twin my_plant.yaml
    """
    files = {file.stem: file for file in map(_plant_file, plants or SHIPPED)}
    folder, console = output_folder(out), Console(markup=False, soft_wrap=True)
    folders = {name: output_folder(folder / name) for name in files}
    for name, file in files.items():
        for seed, walk in enumerate(WALKS):
            recording = folders[name] / f"{walk}.mcap"
            if not (reuse and recording.exists()):
                console.rule(f"{name}: walk {seed + 1} of {len(WALKS)}")
                _walk(file, recording, seed, console)
    new = {name: here for name, here in folders.items() if not (reuse and _identified(here))}
    if new:
        _identify(new, console)
    results = evaluate_models(folders, console)
    for result in results:
        console.print(_table(result))
    write_json(folder / "twin.json", {"schema": SCHEMA, "plants": results})
    with atomic_write(folder / "twin.html") as draft:
        draft.write_text(twin_page(results), encoding="utf-8")
    console.print(f"{summary_sentence(results)}\nwritten to {folder}: twin.html, twin.json", highlight=False)


def _plant_file(plant: str) -> Path:
    """Return the file of a plant after a check of its content."""
    file = PLANTS / f"{plant}.yaml" if plant in SHIPPED else Path(plant)
    if not file.is_file():
        raise FileNotFoundError(f"{plant}: no such plant; expected {', '.join(SHIPPED)} or a YAML file")
    read_plant(file)  # report errors before any walk
    return file


def plant_nodes(file: Path, seed: int) -> dict[str, list[str]]:
    """Return the command lines of the stack in lockstep, with the plant as its simulator.

    The nodes use the states on `board/low_state` (200 Hz); `low_state` is the plant's log (1 kHz).

    Args:
        file: The plant's file.
        seed: Seed of its noise.

    Returns:
        Command lines by name of the node.
    """
    commands = Stack(use_sim_time=True).commands()
    arguments = Stack(use_sim_time=True).arguments()["sim_node"]
    commands["sim_node"] = [sys.executable, "-m", "quadvel_lab.plant", str(file.resolve()), *arguments]
    for name in ("sim_node", "estimator", "controller"):
        commands[name] += ["-r", "low_state:=board/low_state"]
    commands["sim_node"] += ["-r", "joint_log:=low_state", "-p", f"seed:={seed}"]
    return commands


def _walk(file: Path, recording: Path, seed: int, console: Console) -> None:
    """Record a walk of the plant; exit code 1 if it did not complete the script."""
    with atomic_write(recording) as draft:
        problem = ScriptedWalk(draft, SCRIPT, plant_nodes(file, seed), True, console).run()
        if problem:
            console.print(f"{file.stem} did not walk to the end: {problem}", style="bold red")
            raise typer.Exit(1)


def _identified(folder: Path) -> bool:
    """Return whether the report is newer than the recordings."""
    report = folder / "identify" / "report.json"
    written = [(folder / f"{walk}.mcap").stat().st_mtime for walk in WALKS]
    return report.exists() and report.stat().st_mtime >= max(written)


def _identify(folders: Mapping[str, Path], console: Console) -> None:
    """Run `quadvel identify` on each plant's recordings, in processes with access to nothing else.

    If one fails or a signal arrives, it ends with an exit code; existing reports stay unchanged.
    """
    lines: dict[str, list[str]] = {name: [] for name in folders}
    columns = (TextColumn("identifying"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bar = Progress(*columns, console=console)
    with StopSignals() as signals, bar, ProcessGroup(lambda name, line: lines[name].append(line)) as group:
        task = bar.add_task("", total=len(folders))
        for name, folder in folders.items():
            fitted, held_out = (str(folder / f"{walk}.mcap") for walk in WALKS)
            line = ["identify", fitted, "--holdout", held_out, "--out", str(folder / "identify")]
            one_thread = {"OMP_NUM_THREADS": "1"}  # the processes share the cores
            group.start(name, [sys.executable, "-m", "quadvel_bringup", *line], one_thread)
        ended: dict[str, int] = {}
        while len(ended) < len(folders) and not any(ended.values()) and not signals.wait(POLL_PERIOD_S):
            ended = group.ended()
            bar.update(task, completed=len(ended))
    if signals.received:
        raise typer.Exit(128 + signals.received)
    for name, code in ended.items():
        if code:
            reason = lines[name][-1] if lines[name] else f"exit code {code}"
            console.print(f"{name} was not identified: {reason}", style="bold red")
            raise typer.Exit(code)


@attrs.frozen(eq=False)
class RecordedWalk:
    """A recorded walk of the plant.

    Attributes:
        recording: The recording.
        joints: Its joint states and commands.
        stretches: Start (s), end (s) and command (3,) of the evaluated part.
        segments: Mean velocities by command.
    """

    recording: Recording
    joints: replay.JointRecord
    stretches: list[tuple[float, float, np.ndarray]]
    segments: list[Segment]


def read_walk(path: Path) -> RecordedWalk:
    """Read a recorded walk.

    Args:
        path: The recording.

    Returns:
        The walk.

    Raises:
        ValueError: It has no long constant command.
    """
    recording = read_recording(path)
    moving = [
        c
        for c in demo_summary.constant_commands(recording.planned.time, recording.planned.value)
        if c[2].any()
    ]
    segments = [segment for segment in demo_summary.recorded_segments(recording) if segment.command.any()]
    if not moving:
        raise ValueError(
            f"{path}: cmd_vel: found no velocity command that lasts long enough for an evaluation"
        )
    return RecordedWalk(recording, replay.read_joints(path), moving, segments)


def evaluate_models(folders: Mapping[str, Path], console: Console) -> list[dict[str, Any]]:
    """Compare the stack's model and the corrected model with the plants' walks.

    Args:
        folders: Folders with walks and reports by plant.
        console: Console for the bar.

    Returns:
        The entries of `twin.json`.
    """
    robot = load_robot(DEFAULT_ROBOT)
    own = ActuatorParameters.of(robot)
    drives = [step for step in SCRIPTS[SCRIPT] if isinstance(step, Drive) and any(step.velocity)]
    commands = [(np.array(step.velocity), step.duration) for step in drives]
    calls: list[Call] = [(replay.predicted_tracking, robot, own, commands, seed) for seed in MODEL_SEEDS]
    for folder in folders.values():
        corrected = ActuatorParameters.load(robot, folder / "identify" / "actuator.yaml")
        calls += [(replay.predicted_tracking, robot, corrected, commands, seed) for seed in MODEL_SEEDS]
        calls += [(_replay_errors, robot, model, folder / f"{WALKS[1]}.mcap") for model in (own, corrected)]
    answers = iter(_answers(calls, console))
    before = _average([next(answers) for _ in MODEL_SEEDS])
    return [_entry(name, folder, before, answers) for name, folder in folders.items()]


def _entry(name: str, folder: Path, before: Sequence[Segment], answers: Iterator[Any]) -> dict[str, Any]:
    """Return the entry of a plant.

    `answers`: results of its calls in `evaluate_models`, in order.
    """
    report = read_json(folder / "identify" / "report.json")
    walks = [read_walk(folder / f"{walk}.mcap").segments for walk in WALKS]
    plant = _average(walks)
    entry: dict[str, Any] = {
        "name": name,
        "decision": report["decision"],
        "effects": [effect["name"] for effect in report["effects"]],
        "unexplained": report["unexplained"],
        "fit": {"eam": report["before"]["heldout_mse"], "corrected": report["after"]["heldout_mse"]},
        "noise_floor": report["noise_floor"],
        "segments": [{"command": rounded(s.command), "plant": rounded(s.mean)} for s in plant],
        "repeat": _gap(*walks),
    }
    for when, predicted in (("before", before), ("after", _average([next(answers) for _ in MODEL_SEEDS]))):
        entry[when] = {"tracking": _gap(plant, predicted)}
        for segment, model_segment in zip(entry["segments"], predicted, strict=True):
            segment[when] = rounded(model_segment.mean)
    for when in ("before", "after"):
        torque, error = next(answers)
        entry[when] |= {
            "torque_mse": rounded(torque),
            **attrs.asdict(error, filter=attrs.filters.exclude("growth")),
            "growth": rounded(error.growth),
        }
    return entry


def _replay_errors(
    robot: Robot, model: ActuatorParameters, recording: Path
) -> tuple[float, replay.ReplayError]:
    """Return the torque error (N^2 m^2) and the open-loop error of a model on a recorded walk."""
    walk = read_walk(recording)
    begin, end = walk.stretches[0][0], walk.stretches[-1][1]
    torque = replay.torque_error(model, walk.joints, begin, end)
    return torque, replay.open_loop_error(
        robot, model, walk.joints, replay.recorded_truth(walk.recording), begin, end
    )


def _answers(calls: Sequence[Call], console: Console) -> list[Any]:
    """Run the calls on all cores under a bar; returns their results in order."""
    answers: list[Any] = [None] * len(calls)
    columns = (TextColumn("before and after"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=len(calls))
        for i, answer in run_in_parallel(calls):
            answers[i] = answer
            bar.advance(task)
    return answers


def _average(runs: Sequence[Sequence[Segment]]) -> list[Segment]:
    """Return the mean of several runs of the same commands, by segment."""
    return [
        Segment(same[0].command, np.mean([s.mean for s in same], axis=0)) for same in zip(*runs, strict=True)
    ]


def _gap(plant: Sequence[Segment], model: Sequence[Segment]) -> dict[str, float]:
    """Return the velocity tracking gap between plant and model."""
    xy, wz = replay.tracking_gap(plant, model)
    return {"xy": rounded(xy), "wz": rounded(wz)}


def _table(result: dict[str, Any]) -> Table:
    """Return a table of the errors before and after."""
    table = Table(
        "error of the model against the plant",
        "before",
        "after",
        title=f"{result['name']}: {result['decision']}",
    )
    for row in ROWS:
        table.add_row(row.title, *(f"{row.error(result[when]):.4g}" for when in ("before", "after")))
    return table
