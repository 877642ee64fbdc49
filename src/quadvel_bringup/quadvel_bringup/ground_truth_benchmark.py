"""`quadvel twin`: closes the loop on the stack itself.

A plant whose drives hold something that the stack's model lacks walks with the shipped policy, as processes over DDS;
`quadvel identify` sees the recording alone; the corrected model goes into the stack's simulator, and what that
predicts is held against what the plant did. The plant's file is read by the plant's process alone.
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
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from quadvel_actuator import ActuatorParameters
from quadvel_eval import demo_summary, replay
from quadvel_eval.output import output_folder, replacing
from quadvel_eval.pool import Call, run_in_parallel
from quadvel_eval.recording import Recording, read_recording
from quadvel_eval.report import read_json, write_json
from quadvel_eval.script import SCRIPTS, Drive
from quadvel_eval.segments import Segment, rounded

from .ground_truth_page import ROWS, decision, twin_page
from .plant import read_plant
from .processes import ProcessGroup, StopSignals
from .recorded_run import LOOK
from .scripted_walk import ScriptedWalk
from .stack import Stack

PLANTS = Path(__file__).parent / "config" / "plants"
SHIPPED = ("dry_gears", "slow_current", "chafing_cable")
SCRIPT = "circuit"
WALKS = ("walk_1", "walk_2")
"""The first is fitted, the second is held out; they differ in the seed of the noise."""
SEEDS = (0, 1)  # of the model's walks
SCHEMA = 1


def twin_command(
    plants: Annotated[
        list[str] | None,
        typer.Argument(help=f"Shipped plants ({', '.join(SHIPPED)}) or YAML files.", show_default="all"),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="<folder>", help="Folder for the results.")] = Path("out/twin"),
    reuse: Annotated[
        bool, typer.Option("--reuse", help="Take up the recordings and reports that are there.")
    ] = False,
) -> None:
    """Walk plants that the model does not know, identify what it lacks, and hold the corrected model against them.

    A plant walks a circuit twice, as processes over DDS; `quadvel identify` sees the recordings alone. OUT/twin.html
    says what was found in each plant, and how far the model was from it before and after.

    \b
    For example:
      quadvel twin dry_gears --out out/twin
      quadvel twin my_plant.yaml
    """
    files = {file.stem: file for file in map(_plant_file, plants or SHIPPED)}
    folder, console = output_folder(out), Console(soft_wrap=True)
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
    results = judge(folders, console)
    for result in results:
        console.print(_table(result))
    write_json(folder / "twin.json", {"schema": SCHEMA, "plants": results})
    with replacing(folder / "twin.html") as draft:
        draft.write_text(twin_page(results), encoding="utf-8")
    console.print(f"{decision(results)}\nwritten to {folder}: twin.html, twin.json", highlight=False)


def _plant_file(plant: str) -> Path:
    file = PLANTS / f"{plant}.yaml" if plant in SHIPPED else Path(plant)
    if not file.is_file():
        raise FileNotFoundError(f"{plant}: no such plant; expected {', '.join(SHIPPED)} or a YAML file")
    read_plant(file)  # what is wrong with it shows here, before any walk
    return file


def plant_nodes(file: Path, seed: int) -> dict[str, list[str]]:
    """Command lines of the stack in lockstep, its simulator replaced by the plant.

    The nodes follow the states on `board/low_state`, 200 a second; `low_state` is the plant's log of each ms.
    """
    commands = Stack(use_sim_time=True).commands()
    arguments = Stack(use_sim_time=True).arguments()["sim_node"]
    commands["sim_node"] = [sys.executable, "-m", "quadvel_bringup.plant", str(file.resolve()), *arguments]
    for name in ("sim_node", "estimator", "controller"):
        commands[name] += ["-r", "low_state:=board/low_state"]
    commands["sim_node"] += ["-r", "joint_log:=low_state", "-p", f"seed:={seed}"]
    return commands


def _walk(file: Path, recording: Path, seed: int, console: Console) -> None:
    """Record the plant's walk. Ends with exit code 1 where the script did not go through."""
    with replacing(recording) as draft:
        problem = ScriptedWalk(draft, SCRIPT, plant_nodes(file, seed), True, console).run()
        if problem:
            console.print(f"[bold red]{file.stem} did not walk to the end: {problem}")
            raise typer.Exit(1)


def _identified(folder: Path) -> bool:
    """Whether there is a report that is newer than the recordings."""
    report = folder / "identify" / "report.json"
    written = [(folder / f"{walk}.mcap").stat().st_mtime for walk in WALKS]
    return report.exists() and report.stat().st_mtime >= max(written)


def _identify(folders: Mapping[str, Path], console: Console) -> None:
    """`quadvel identify` on the recordings of every plant, as processes that see nothing else.

    Ends with an exit code where one of them fails or a signal comes; reports that are there stay as they were.
    """
    lines: dict[str, list[str]] = {name: [] for name in folders}
    columns = (TextColumn("identifying"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bar = Progress(*columns, console=console)
    with StopSignals() as signals, bar, ProcessGroup(lambda name, line: lines[name].append(line)) as group:
        task = bar.add_task("", total=len(folders))
        for name, folder in folders.items():
            fitted, held_out = (str(folder / f"{walk}.mcap") for walk in WALKS)
            line = ["identify", fitted, "--holdout", held_out, "--out", str(folder / "identify")]
            one_thread = {"OMP_NUM_THREADS": "1"}  # they share the cores among them
            group.start(name, [sys.executable, "-m", "quadvel_bringup", *line], one_thread)
        ended: dict[str, int] = {}
        while len(ended) < len(folders) and not any(ended.values()) and not signals.wait(LOOK):
            ended = group.ended()
            bar.update(task, completed=len(ended))
    if signals.received:
        raise typer.Exit(128 + signals.received)
    for name, code in ended.items():
        if code:
            reason = lines[name][-1] if lines[name] else f"exit code {code}"
            console.print(f"[bold red]{name} was not identified: {escape(reason)}")
            raise typer.Exit(code)


@attrs.frozen(eq=False)
class Walked:
    """A recorded walk of the plant, and its part that is judged."""

    recording: Recording
    joints: replay.JointRecord
    stretches: list[tuple[float, float, np.ndarray]]  # start, end (s), commanded vx, vy, wz
    segments: list[Segment]


def read_walk(path: Path) -> Walked:
    """Raises ValueError where the walk cannot be judged."""
    recording = read_recording(path)
    moving = [
        c
        for c in demo_summary.constant_commands(recording.planned.time, recording.planned.value)
        if c[2].any()
    ]
    segments = [segment for segment in demo_summary.recorded_segments(recording) if segment.command.any()]
    if not moving:
        raise ValueError(
            f"{path}: cmd_vel: found no velocity that was commanded for long enough to be judged"
        )
    return Walked(recording, replay.read_joints(path), moving, segments)


def judge(folders: Mapping[str, Path], console: Console) -> list[dict[str, Any]]:
    """What the stack's model and the corrected one make of the plants' walks: the entries of `twin.json`."""
    own = ActuatorParameters.default()
    drives = [step for step in SCRIPTS[SCRIPT] if isinstance(step, Drive) and any(step.velocity)]
    commands = [(np.array(step.velocity), step.duration) for step in drives]
    calls: list[Call] = [(replay.predicted_tracking, own, commands, seed) for seed in SEEDS]
    for folder in folders.values():
        corrected = ActuatorParameters.load(folder / "identify" / "actuator.yaml")
        calls += [(replay.predicted_tracking, corrected, commands, seed) for seed in SEEDS]
        calls += [(_replayed, model, folder / f"{WALKS[1]}.mcap") for model in (own, corrected)]
    answers = iter(_answers(calls, console))
    before = _average([next(answers) for _ in SEEDS])
    return [_entry(name, folder, before, answers) for name, folder in folders.items()]


def _entry(name: str, folder: Path, before: Sequence[Segment], answers: Iterator[Any]) -> dict[str, Any]:
    """A plant's entry. answers: of the calls that `judge` made for it, in their order."""
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
    for when, predicted in (("before", before), ("after", _average([next(answers) for _ in SEEDS]))):
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


def _replayed(model: ActuatorParameters, recording: Path) -> tuple[float, replay.ReplayError]:
    """Torque error (N^2 m^2) and open-loop error of a model against the walk recorded there."""
    walk = read_walk(recording)
    begin, end = walk.stretches[0][0], walk.stretches[-1][1]
    torque = replay.torque_error(model, walk.joints, begin, end)
    return torque, replay.open_loop_error(
        model, walk.joints, replay.recorded_truth(walk.recording), begin, end
    )


def _answers(calls: Sequence[Call], console: Console) -> list[Any]:
    """What the calls return, in their order; they run on all cores, under a bar."""
    answers: list[Any] = [None] * len(calls)
    columns = (TextColumn("before and after"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=len(calls))
        for i, answer in run_in_parallel(calls):
            answers[i] = answer
            bar.advance(task)
    return answers


def _average(runs: Sequence[Sequence[Segment]]) -> list[Segment]:
    """The mean of several runs of the same commands, segment by segment."""
    return [
        Segment(same[0].command, np.mean([s.mean for s in same], axis=0)) for same in zip(*runs, strict=True)
    ]


def _gap(plant: Sequence[Segment], model: Sequence[Segment]) -> dict[str, float]:
    xy, wz = replay.tracking_gap(plant, model)
    return {"xy": rounded(xy), "wz": rounded(wz)}


def _table(result: dict[str, Any]) -> Table:
    table = Table(
        "error of the model against the plant",
        "before",
        "after",
        title=f"{result['name']}: {result['decision']}",
    )
    for row in ROWS:
        table.add_row(row.title, *(f"{row.error(result[when]):.4g}" for when in ("before", "after")))
    return table
