"""Defines the command `quadvel paper` for Typer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_estimator.learned import LearnedEstimator, shipped_estimator
from quadvel_policy.policy_file import PolicyFile
from quadvel_recordings.output import output_folder

from ..cli import ClusterOption, RobotOption, walk_progress_bar
from .files import PAGE_FILE
from .section import Section, Study
from .study import SECTIONS, Progress, run_sections


def paper_command(
    out: Annotated[
        Path, typer.Option(metavar="<folder>", help="Folder for the page, pictures and tables.")
    ] = Path("out/paper"),
    policy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="<name=file>",
            help="A policy and its name; may be given several times.",
            show_default="the shipped one",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="<section>",
            help=f"One of {', '.join(s.name for s in SECTIONS)}; may be given several times.",
            show_default="all",
        ),
    ] = None,
    estimator: Annotated[
        Literal["learned", "kalman", "truth"], typer.Option(help="Velocity estimator in the loop.")
    ] = "learned",
    robot: RobotOption = DEFAULT_ROBOT,
    estimator_file: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="ONNX file of the learned estimator.", show_default="the shipped one"
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each walk, with seeds 0, 1, ...")] = 3,
    again: Annotated[bool, typer.Option("--again", help="Run finished sections, too.")] = False,
    cluster: ClusterOption = None,
) -> None:
    """Repeat Section 4 of the paper in simulation: a page with both values, pictures and CSV files.

    Sections made with the same networks, seeds and settings are kept; an interrupted run continues.

    \b
    For example:
      quadvel paper --out docs/results/paper
      quadvel paper --out out/ablation --policy rl_pd=a.onnx --policy crl_eam=b.onnx --only tracking --only gap
    """
    policies = _policies(policy or [])
    chosen = load_robot(robot)
    for path in policies.values():
        PolicyFile(chosen, path)  # fail on a bad file here, once, before any run
    study = Study(
        robot=robot,
        **({"policies": policies} if policies else {}),
        estimator=estimator,
        estimator_file=estimator_file or shipped_estimator(chosen),
        seeds=seeds,
    )
    LearnedEstimator(chosen, study.estimator_file)
    sections = _sections(only or [])
    folder = output_folder(out)
    with walk_progress_bar() as bar:
        task = bar.add_task("walks", total=None)

        def show_progress(progress: Progress) -> None:
            bar.update(task, completed=progress.done, total=progress.total)
            if progress.completed:
                bar.console.print(
                    f"{progress.completed}: done, {progress.seconds / 60.0:.1f} min of a core",
                    highlight=False,
                )

        done = run_sections(study, sections, folder, again, cluster, show_progress)
    kept = [section.name for section in sections if section.name not in done]
    console = Console(markup=False)
    if kept:
        console.print(f"unchanged: {', '.join(kept)}")
    console.print(f"written: {folder}/{PAGE_FILE}")


def _policies(given: list[str]) -> dict[str, Path]:
    """Parse NAME=FILE, each name once."""
    policies: dict[str, Path] = {}
    for text in given:
        name, equals, file = text.partition("=")
        if not (name and equals and file) or name in policies:
            raise ValueError(f"--policy: found {text!r}, expected NAME=FILE with a unique name")
        policies[name] = Path(file)
    return policies


def _sections(only: list[str]) -> list[Section]:
    """Sections of the given names; all if none is given."""
    known = {section.name: section for section in SECTIONS}
    for name in only:
        if name not in known:
            raise ValueError(f"--only: found {name!r}, expected one of {', '.join(known)}")
    return [section for name, section in known.items() if not only or name in only]
