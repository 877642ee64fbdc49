"""`quadvel twin`: closes the loop on the stack itself.

A plant whose drives hold something that the stack's model lacks walks with the shipped policy, as processes over DDS;
`quadvel identify` sees the recording alone; the corrected model goes into the stack's simulator, and what that
predicts is held against what the plant did. The plant's file is read by the plant's process alone.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import attrs
import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from quadvel_actuator import ActuatorParameters
from quadvel_eval import demo_summary, replay
from quadvel_eval.pool import Call, in_parallel
from quadvel_eval.recording import Recording, read_recording
from quadvel_eval.report import output_folder, replacing, write_json
from quadvel_eval.segments import Segment, rounded

from .processes import run_attended
from .scripted_walk import ScriptedWalk
from .stack import Stack
from .twin_page import ROWS, twin_page

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
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/twin"),
    reuse: Annotated[bool, typer.Option("--reuse", help="Take up the recordings that are there.")] = False,
) -> None:
    """Walk plants that the model does not know, identify what it lacks, and hold the corrected model against them.

    A plant walks a circuit twice, as processes over DDS; `quadvel identify` sees the recordings alone. OUT/twin.html
    says what was found in each plant, and how far the model was from it before and after.

    \b
    For example:
      quadvel twin dry_gears --out out/twin
      quadvel twin my_plant.yaml
    """
    files = [_plant_file(plant) for plant in plants or SHIPPED]
    folder, console = output_folder(out), Console(soft_wrap=True)
    results = []
    for file in files:
        console.rule(file.stem)
        here = output_folder(folder / file.stem)
        for seed, walk in enumerate(WALKS):
            if not (reuse and (here / f"{walk}.mcap").exists()):
                console.print(f"walk {seed + 1} of {len(WALKS)}")
                _walk(file, here / f"{walk}.mcap", seed, console)
        _identify(here)
        results.append({"name": file.stem, **judge(here, console)})
        console.print(_table(results[-1]))
    write_json(folder / "twin.json", {"schema": SCHEMA, "plants": results})
    with replacing(folder / "twin.html") as draft:
        draft.write_text(twin_page(results), encoding="utf-8")
    console.print(f"written to {folder}: twin.html, twin.json")


def _plant_file(plant: str) -> Path:
    file = PLANTS / f"{plant}.yaml" if plant in SHIPPED else Path(plant)
    if not file.is_file():
        raise FileNotFoundError(f"{plant}: no such plant; expected {', '.join(SHIPPED)} or a YAML file")
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


def _identify(folder: Path) -> None:
    """`quadvel identify` on the recordings, as a process that sees nothing else."""
    fitted, held_out = (str(folder / f"{walk}.mcap") for walk in WALKS)
    line = ["identify", fitted, "--holdout", held_out, "--out", str(folder / "identify")]
    if code := run_attended([sys.executable, "-m", "quadvel_bringup", *line]):
        raise typer.Exit(code)


@attrs.frozen(eq=False)
class Walked:
    """A recorded walk of the plant, and its part that is judged."""

    recording: Recording
    joints: replay.Joints
    stretches: list[tuple[float, float, np.ndarray]]  # start, end (s), commanded vx, vy, wz
    segments: list[Segment]


def read_walk(path: Path) -> Walked:
    """Raises ValueError where the walk cannot be judged."""
    recording = read_recording(path)
    moving = [c for c in demo_summary.commands(recording.planned.time, recording.planned.value) if c[2].any()]
    segments = [segment for segment in demo_summary.segments(recording) if segment.command.any()]
    if not moving:
        raise ValueError(
            f"{path}: cmd_vel: found no velocity that was commanded for long enough to be judged"
        )
    return Walked(recording, replay.read_joints(path), moving, segments)


def judge(folder: Path, console: Console) -> dict[str, Any]:
    """What the stack's model and the corrected one make of the plant's walks: an entry of `twin.json`."""
    report = json.loads((folder / "identify" / "report.json").read_text())
    models = {
        "before": ActuatorParameters.default(),
        "after": ActuatorParameters.load(folder / "identify" / "actuator.yaml"),
    }
    walks = [read_walk(folder / f"{walk}.mcap") for walk in WALKS]
    plant = _average([walk.segments for walk in walks])
    entry: dict[str, Any] = {
        "decision": report["decision"],
        "effects": [effect["name"] for effect in report["effects"]],
        "unexplained": report["unexplained"],
        "fit": {"eam": report["before"]["heldout_mse"], "corrected": report["after"]["heldout_mse"]},
        "noise_floor": report["noise_floor"],
        "segments": [{"command": rounded(s.command), "plant": rounded(s.mean)} for s in plant],
        "repeat": _gap(walks[0].segments, walks[1].segments),
    }
    commands = [(velocity, stop - start) for start, stop, velocity in walks[1].stretches]
    calls: list[Call] = []
    for model in models.values():
        calls += [(replay.predicted_tracking, model, commands, seed) for seed in SEEDS]
        calls.append((_replayed, model, folder / f"{WALKS[1]}.mcap"))
    answers = _answers(calls, console)
    for name in models:
        *runs, (torque, error) = (answers.pop(0) for _ in range(len(SEEDS) + 1))
        predicted = _average(runs)
        entry[name] = {
            "torque_mse": rounded(torque),
            **attrs.asdict(error, filter=attrs.filters.exclude("growth")),
            "growth": rounded(error.growth),
            "tracking": _gap(plant, predicted),
        }
        for segment, model_segment in zip(entry["segments"], predicted, strict=True):
            segment[name] = rounded(model_segment.mean)
    return entry


def _replayed(model: ActuatorParameters, recording: Path) -> tuple[float, replay.ReplayError]:
    """Torque error (N^2 m^2) and open-loop error of a model against the walk recorded there."""
    walk = read_walk(recording)
    begin, end = walk.stretches[0][0], walk.stretches[-1][1]
    torque = replay.torque_error(model, walk.joints, begin, end)
    return torque, replay.open_loop(model, walk.joints, replay.trunk_at(walk.recording), begin, end)


def _answers(calls: Sequence[Call], console: Console) -> list[Any]:
    """What the calls return, in their order; they run on all cores, under a bar."""
    answers: list[Any] = [None] * len(calls)
    columns = (TextColumn("before and after"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=len(calls))
        for i, answer in in_parallel(calls):
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
    table = Table("error of the model against the plant", "before", "after", title=result["decision"])
    for row in ROWS:
        table.add_row(row.title, *(f"{row.error(result[when]):.4g}" for when in ("before", "after")))
    return table
