"""The commands `quadvel eval`, `compare`, `paper` and `bench`, as functions for a typer application."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from quadvel_estimator.learned import SHIPPED_MODEL, LearnedEstimator
from quadvel_policy.policy_file import SHIPPED_POLICY, PolicyFile

from . import bench
from .compare import comparison_table, read_evaluation
from .grid import evaluate
from .paper import study as paper
from .paper.section import Section, Study
from .report import evaluation_table, output_folder, write_evaluation, write_json
from .walk import Setup

Cluster = Annotated[
    str | None,
    typer.Option(
        help="Address of a Dask scheduler to run the walks on.", show_default="the cores of this machine"
    ),
]


def eval_command(
    out: Annotated[Path, typer.Option(help="Folder for eval.json, eval.csv and eval.png.")],
    grid: Annotated[Literal["quick", "paper"], typer.Option(help="Which commands are tried.")],
    policy: Annotated[Path, typer.Option(help="ONNX file of the policy.")] = SHIPPED_POLICY,
    estimator: Annotated[
        Literal["learned", "kalman", "truth"], typer.Option(help="Velocity estimator in the loop.")
    ] = "learned",
    estimator_file: Annotated[Path, typer.Option(help="ONNX file of the learned one.")] = SHIPPED_MODEL,
    terrain: Annotated[Literal["flat", "rough", "slope"], typer.Option(help="The ground.")] = "flat",
    randomised: Annotated[
        bool, typer.Option("--randomised", help="Draw payload, friction, joints and actuators by the seed.")
    ] = False,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each command, with seeds 0, 1, ...")] = 1,
    cluster: Cluster = None,
) -> None:
    """Measure how well a policy tracks velocities: many walks in parallel, faster than real time."""
    setup = Setup(
        policy=policy,
        estimator=estimator,
        estimator_file=estimator_file,
        terrain=terrain,
        randomised=randomised,
    )
    PolicyFile(policy)  # what is wrong with the files shows here, once, before any run
    LearnedEstimator(estimator_file)
    folder = output_folder(out)
    with _walks() as bar:
        task = bar.add_task("walks", total=None)
        result = evaluate(
            setup, grid, seeds, lambda done, of: bar.update(task, completed=done, total=of), cluster
        )
    write_evaluation(folder, {**result, "setup": {**setup.to_json(), "grid": grid, "seeds": seeds}})
    console = Console()
    console.print(evaluation_table(result))
    console.print(f"written: {folder}/eval.json, eval.csv, eval.png")


def _walks() -> Progress:
    """A bar for walks, on stderr."""
    columns = (TextColumn("walks"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True))


def paper_command(
    out: Annotated[Path, typer.Option(help="Folder for the page, pictures and tables.")],
    policy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FILE",
            help="A policy and its name; may be given several times.",
            show_default="the shipped one",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SECTION",
            help=f"One of {', '.join(s.name for s in paper.SECTIONS)}; may be given several times.",
            show_default="all",
        ),
    ] = None,
    estimator: Annotated[
        Literal["learned", "kalman", "truth"], typer.Option(help="Velocity estimator in the loop.")
    ] = "learned",
    estimator_file: Annotated[Path, typer.Option(help="ONNX file of the learned one.")] = SHIPPED_MODEL,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each walk, with seeds 0, 1, ...")] = 3,
    again: Annotated[bool, typer.Option("--again", help="Run sections that are done already, too.")] = False,
    cluster: Cluster = None,
) -> None:
    """Measure what Section 4 of the paper shows: a page with its values beside ours, pictures and CSV files.

    Sections whose files were made with the same networks, seeds and settings are kept; what was stopped goes on.

    \b
    For example:
      quadvel paper --out docs/results/paper
      quadvel paper --out out/ablation --policy rl_pd=a.onnx --policy crl_eam=b.onnx --only tracking --only gap
    """
    policies = _policies(policy or [])
    study = Study(
        **({"policies": policies} if policies else {}),
        estimator=estimator,
        estimator_file=estimator_file,
        seeds=seeds,
    )
    for path in study.policies.values():
        PolicyFile(path)  # what is wrong with the files shows here, once, before any run
    LearnedEstimator(estimator_file)
    sections = _sections(only or [])
    folder = output_folder(out)
    with _walks() as bar:
        task = bar.add_task("walks", total=None)

        def tell(progress: paper.Progress) -> None:
            bar.update(task, completed=progress.done, total=progress.total)
            if progress.completed:
                bar.console.print(
                    f"{progress.completed}: done, {progress.seconds / 60.0:.1f} min of a core",
                    highlight=False,
                )

        done = paper.run(study, sections, folder, again, cluster, tell)
    kept = [section.name for section in sections if section.name not in done]
    console = Console()
    if kept:
        console.print(f"kept as they were: {', '.join(kept)}")
    console.print(f"written: {folder}/{paper.PAGE}")


def _policies(given: list[str]) -> dict[str, Path]:
    """NAME=FILE, each name once."""
    policies: dict[str, Path] = {}
    for text in given:
        name, equals, file = text.partition("=")
        if not (name and equals and file) or name in policies:
            raise ValueError(f"--policy: found {text!r}, expected NAME=FILE with a name of its own")
        policies[name] = Path(file)
    return policies


def _sections(only: list[str]) -> list[Section]:
    """The sections of these names, all where there are none."""
    known = {section.name: section for section in paper.SECTIONS}
    for name in only:
        if name not in known:
            raise ValueError(f"--only: found {name!r}, expected one of {', '.join(known)}")
    return [section for name, section in known.items() if not only or name in only]


def compare_command(
    first: Annotated[Path, typer.Argument(help="eval.json, or a folder that holds one.")],
    second: Annotated[Path, typer.Argument(help="The one to hold against it.")],
) -> None:
    """Show two evaluations of `quadvel eval` side by side."""
    Console().print(comparison_table({str(path): read_evaluation(path) for path in (first, second)}))


def bench_command(
    out: Annotated[Path, typer.Option(help="JSON file for the figures.")] = Path("out/bench.json"),
) -> None:
    """Measure how fast this machine simulates, infers, talks and trains; on an idle machine, some minutes."""
    output_folder(out.parent)
    results = {}
    messages = Console(stderr=True)
    with messages.status("") as status:
        for name in bench.PARTS:
            status.update(f"measuring: {name}")
            results[name] = bench.PARTS[name]()
    write_json(out, {"schema": bench.SCHEMA, "machine": bench.machine(), **results})
    console = Console()
    console.print(bench.table(results))
    console.print(f"written: {out}")
