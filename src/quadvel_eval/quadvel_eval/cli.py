"""Defines the commands `quadvel eval`, `faults`, `compare` and `bench` for Typer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from quadvel_actuator import ActuatorParameters
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_estimator.learned import LearnedEstimator
from quadvel_policy.policy_file import load_policy, shipped_policy
from quadvel_recordings.output import output_file, output_folder

from . import bench
from .compare import comparison_table, read_evaluation
from .faults.campaign import run_campaign
from .faults.report import campaign_summary, campaign_table, write_campaign
from .grid import evaluate, grid_cells
from .paper.cells import is_within_limits
from .report import evaluation_table, write_evaluation, write_json
from .walk import Setup

ClusterOption = Annotated[
    str | None,
    typer.Option(
        metavar="<address>",
        help="Address of a Dask scheduler that runs the walks.",
        show_default="the cores of this machine",
    ),
]


LIVE_S = 60.0  # duration of `quadvel bench --live`
RobotOption = Annotated[
    str,
    typer.Option(
        "--robot", metavar="<name|file>", help="The robot: aliengo, go2, or a robot.yaml or its folder."
    ),
]


def eval_command(
    grid: Annotated[Literal["quick", "paper"], typer.Option(help="Grid of commands.")],
    out: Annotated[
        Path, typer.Option(metavar="<folder>", help="Folder for eval.json, eval.csv and eval.png.")
    ] = Path("out/eval"),
    robot: RobotOption = DEFAULT_ROBOT,
    policy: Annotated[
        Path | None,
        typer.Option(metavar="<file>", help="ONNX file of the policy.", show_default="the shipped one"),
    ] = None,
    estimator: Annotated[
        Literal["learned", "kalman", "truth"], typer.Option(help="Velocity estimator in the loop.")
    ] = "learned",
    estimator_file: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="ONNX file of the learned estimator.", show_default="the shipped one"
        ),
    ] = None,
    terrain: Annotated[Literal["flat", "rough", "slope"], typer.Option(help="Terrain.")] = "flat",
    actuator: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="Actuator model of the simulated robot.", show_default="the shipped one"
        ),
    ] = None,
    randomised: Annotated[
        bool,
        typer.Option("--randomised", help="Randomise payload, friction, joints and actuators by the seed."),
    ] = False,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each command, with seeds 0, 1, ...")] = 1,
    cluster: ClusterOption = None,
) -> None:
    """Measure how well a policy tracks velocities, in many walks in parallel."""
    chosen = load_robot(robot)
    named: dict[str, Any] = {} if estimator_file is None else {"estimator_file": estimator_file}
    setup = Setup(
        robot=robot,
        policy=policy or shipped_policy(chosen),
        estimator=estimator,
        terrain=terrain,
        randomised=randomised,
        actuator=actuator,
        **named,
    )
    limits = load_policy(chosen, setup.policy).metadata.limits  # fails on a bad file here, before any run
    if setup.estimator_file is not None:
        LearnedEstimator(chosen, setup.estimator_file)
    if actuator is not None:
        ActuatorParameters.load(chosen, actuator)
    folder, console = output_folder(out), Console(markup=False)
    commands = [cell.command for cell in grid_cells(grid, 1)]
    if beyond := sum(not is_within_limits(command, limits) for command in commands):
        console.print(
            f"{beyond} of {len(commands)} commands exceed the policy's limits. The policy gets them clipped; "
            "errors are those against the commands before."
        )
    with walk_progress_bar() as bar:
        task = bar.add_task("walks", total=None)
        result = evaluate(
            setup, grid, seeds, lambda done, of: bar.update(task, completed=done, total=of), cluster
        )
    write_evaluation(folder, {**result, "setup": {**setup.to_json(), "grid": grid, "seeds": seeds}})
    console.print(evaluation_table(result))
    console.print(f"written: {folder}/eval.json, eval.csv, eval.png")


def walk_progress_bar() -> Progress:
    """Create a progress bar for walks, on stderr.

    Returns:
        The bar.
    """
    columns = (TextColumn("walks"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=Console(markup=False, stderr=True))


def faults_command(
    out: Annotated[
        Path, typer.Option(metavar="<folder>", help="Folder for faults.json, faults.md and faults.png.")
    ] = Path("out/faults"),
    seeds: Annotated[
        int,
        typer.Option(
            min=1, help="Runs of each kind of fault, alternating between its modes, with seeds 0, 1, ..."
        ),
    ] = 20,
    only: Annotated[
        str | None,
        typer.Option(
            metavar="<text>",
            help="Only cases whose 'component kind mode' contains this text.",
            show_default="all of them",
        ),
    ] = None,
    robot: RobotOption = DEFAULT_ROBOT,
) -> None:
    """Inject faults into a simulated robot, and measure its reaction and reaction time.

    The exit code is 1 if a reaction is not as expected.
    """
    folder = output_folder(out)
    with walk_progress_bar() as bar:
        task = bar.add_task("walks", total=None)
        runs = run_campaign(robot, seeds, only, lambda done, of: bar.update(task, completed=done, total=of))
    cases = write_campaign(folder, runs)["cases"]
    console = Console(markup=False)
    bad = any(case["as_expected"] < case["runs"] for case in cases)
    if bad:
        console.print(campaign_table(cases))
    console.print(campaign_summary(cases), highlight=False)
    console.print(f"written: {folder}/faults.json, faults.md, faults.png")
    if bad:
        raise typer.Exit(1)


def compare_command(
    first: Annotated[Path, typer.Argument(help="eval.json, or a folder that holds one.")],
    second: Annotated[Path, typer.Argument(help="The evaluation to compare with it.")],
) -> None:
    """Compare two evaluations of `quadvel eval`."""
    Console(markup=False).print(
        comparison_table({str(path): read_evaluation(path) for path in (first, second)})
    )


def bench_command(
    out: Annotated[Path, typer.Option(metavar="<file>", help="JSON file for the figures.")] = Path(
        "out/bench.json"
    ),
    live: Annotated[
        bool,
        typer.Option("--live", help="Start a simulated robot that walks, and measure its nodes instead."),
    ] = False,
    seconds: Annotated[
        float | None,
        typer.Option(min=1.0, metavar="<s>", help="Duration of --live, s.", show_default=f"{LIVE_S:g}"),
    ] = None,
    busy: Annotated[
        int,
        typer.Option(min=0, metavar="<n>", help="Other programs that compute without a pause during --live."),
    ] = 0,
) -> None:
    """Measure how fast this machine simulates, infers, communicates and trains.

    It takes up to some minutes. Run it on an idle machine.
    """
    for option, is_given in (("--seconds", seconds is not None), ("--busy", busy > 0)):
        if is_given and not live:
            raise ValueError(f"{option}: belongs to --live, which was not given")
    output_file(out)
    parts, results = bench.live_parts(seconds or LIVE_S, busy) if live else bench.all_parts(), {}
    messages = Console(markup=False, stderr=True)
    with messages.status("") as status:
        for name, part in parts.items():
            status.update(f"measuring: {name}")
            results[name] = part.measure()
    write_json(out, {"schema": bench.SCHEMA, "machine": bench.machine_info(), **results})
    console = Console(markup=False)
    console.print(bench.benchmark_table(results, parts))
    console.print(f"written: {out}")
