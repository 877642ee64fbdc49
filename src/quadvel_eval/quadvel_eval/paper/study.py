"""Runs sections of the paper's evaluation in parallel; `files` writes each when its last walk ends.

A section is skipped if its files were made with the same networks, seeds and settings.
Therefore an interrupted study continues with the missing sections.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import attrs

from ..pool import run_in_parallel
from .energy import Energy
from .estimator import Estimator
from .files import is_done, write_page, write_section
from .gait import Gait
from .gap import Gap
from .identification import Identification
from .jitter import Jitter
from .letters import Letters
from .robustness import Robustness
from .section import Section, Study
from .slopes import Slopes
from .stance import Stance
from .steps import Steps
from .sustained import Sustained
from .symmetry import Symmetry
from .tracking import Tracking

SECTIONS: tuple[Section, ...] = (
    Identification(),
    Gait(),
    Symmetry(),
    Jitter(),
    Tracking(),
    Sustained(),
    Steps(),
    Letters(),
    Energy(),
    Robustness(),
    Slopes(),
    Gap(),
    Stance(),
    Estimator(),
)
"""All sections, in the order of the page."""


@attrs.frozen
class Progress:
    """Progress after a walk.

    Attributes:
        done: Number of finished walks.
        total: Number of all walks.
        completed: Name of the section that this walk completed, or None.
        seconds: CPU time of all walks of the section so far, s.
    """

    done: int
    total: int
    completed: str | None
    seconds: float


def run_sections(
    study: Study,
    sections: Sequence[Section],
    folder: Path,
    rerun: bool = False,
    cluster: str | None = None,
    report_progress: Callable[[Progress], None] = lambda progress: None,
) -> list[str]:
    """Run the sections that are not done, and write their files and the page.

    Args:
        study: Policies, estimator and seeds.
        sections: Sections to run.
        folder: Folder of the files.
        rerun: Whether to run finished sections, too.
        cluster: Address of a Dask scheduler; None for the cores of this machine.
        report_progress: Called after each walk.

    Returns:
        Names of the sections that ran.
    """
    todo = [section for section in sections if rerun or not is_done(folder, section, study)]
    jobs = [(section, job) for section in todo for job in section.jobs(study)]
    answers: list[Any] = [None] * len(jobs)
    left = Counter(section.name for section, _ in jobs)
    seconds = {section.name: 0.0 for section in todo}
    calls = [(call_with_cpu_time, *job.call) for _, job in jobs]
    for done, (i, (answer, spent)) in enumerate(run_in_parallel(calls, cluster), start=1):
        section = jobs[i][0]
        answers[i] = answer
        left[section.name] -= 1
        seconds[section.name] += spent
        completed = section.name if not left[section.name] else None
        if completed:
            own = [(job.labels, answers[k]) for k, (s, job) in enumerate(jobs) if s is section]
            write_section(folder, section, study, section.to_records(own))
            write_page(folder, SECTIONS, study.robot)
        report_progress(Progress(done, len(jobs), completed, seconds[section.name]))
    write_page(folder, SECTIONS, study.robot)
    return [section.name for section in todo]


def call_with_cpu_time(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Call a function and measure its CPU time.

    Args:
        function: The function.
        *arguments: Its arguments.

    Returns:
        Its answer, and the CPU time, s.
    """
    before = time.process_time()
    answer = function(*arguments)
    return answer, time.process_time() - before
