"""Benchmark of velocity tracking: enter a policy file, or print the table of all entries.

    python -m benchmarks.tracking enter mine policy.onnx --size small
    python -m benchmarks.tracking table --size small

docs/howto/enter-a-benchmark.md describes it.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from benchmarks.tracking.entry import SIZES, entries_table, make_entry, read_entries
from quadvel_bringup.error_sentence import exit_with_sentence
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_eval.cli import ClusterOption, walk_progress_bar
from quadvel_eval.paper.section import Study
from quadvel_eval.paper.study import Progress
from quadvel_policy.policy_file import PolicyFile

app = typer.Typer(add_completion=False)
SizeOption = Annotated[
    Literal["tiny", "small", "large"],
    typer.Option(help="tiny: for a first try; small: half an hour of two cores; large: for a cluster."),
]
OutOption = Annotated[Path, typer.Option(metavar="<folder>", help="Folder of all entries.")]
OUT = Path("out/tracking")


@app.command()
def enter(
    name: Annotated[str, typer.Argument(help="Name of the entry: letters, digits, dashes, underscores.")],
    policy: Annotated[Path, typer.Argument(metavar="<file>", help="ONNX file of the policy.")],
    size: SizeOption = "small",
    robot: Annotated[str, typer.Option(metavar="<name|file>", help="The policy's robot.")] = DEFAULT_ROBOT,
    estimator: Annotated[
        Literal["learned", "kalman", "truth"], typer.Option(help="Velocity estimator in the loop.")
    ] = "learned",
    out: OutOption = OUT,
    cluster: ClusterOption = None,
) -> None:
    """Measure a policy, and write its entry. An interrupted run continues where it stopped."""
    if not re.fullmatch(r"[\w-]+", name):
        raise typer.BadParameter(f"name: found {name!r}, expected letters, digits, dashes, underscores")
    PolicyFile(load_robot(robot), policy)  # fail on a bad file here, once, before any run
    study = Study(robot=robot, policies={name: policy}, estimator=estimator, seeds=SIZES[size].seeds)
    with walk_progress_bar() as bar:
        task = bar.add_task("walks", total=None)

        def show(progress: Progress) -> None:
            bar.update(task, completed=progress.done, total=progress.total)

        entry = make_entry(study, size, out / size / name, cluster, show)
    print(entries_table([entry]))


@app.command()
def table(size: SizeOption = "small", out: OutOption = OUT) -> None:
    """Print all entries of one size as one table."""
    entries = read_entries(out / size)
    if not entries:
        raise typer.BadParameter(f"{out / size}: found no entry; make one with `enter`")
    Console(markup=False).print(entries_table(entries), highlight=False, soft_wrap=True)


if __name__ == "__main__":
    with exit_with_sentence("benchmarks.tracking"):
        app()
