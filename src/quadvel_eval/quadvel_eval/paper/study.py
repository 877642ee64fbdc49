"""Runs sections: all their walks in parallel, each section's files as soon as its last walk is through.

A section whose files were made with the same networks, seeds and settings is done and stays; what is stopped in the
middle goes on with the sections that are missing.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import attrs

from ..pool import in_parallel
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
    Letters(),
    Energy(),
    Robustness(),
    Slopes(),
    Gap(),
    Stance(),
    Estimator(),
)
"""in the order of the page"""


@attrs.frozen
class Progress:
    """What is told after each walk: how many of how many, and of the section that it completed."""

    done: int
    total: int
    completed: str | None
    """its name"""
    seconds: float
    """CPU time of all its walks, s"""


def run(
    study: Study,
    sections: Sequence[Section],
    folder: Path,
    again: bool = False,
    cluster: str | None = None,
    tell: Callable[[Progress], None] = lambda progress: None,
) -> list[str]:
    """Run the sections that are not done yet, all of them where `again`; their names."""
    todo = [section for section in sections if again or not is_done(folder, section, study)]
    jobs = [(section, job) for section in todo for job in section.jobs(study)]
    answers: list[Any] = [None] * len(jobs)
    left = Counter(section.name for section, _ in jobs)
    seconds = {section.name: 0.0 for section in todo}
    calls = [(timed, *job.call) for _, job in jobs]
    for done, (i, (answer, spent)) in enumerate(in_parallel(calls, cluster), start=1):
        section = jobs[i][0]
        answers[i] = answer
        left[section.name] -= 1
        seconds[section.name] += spent
        completed = section.name if not left[section.name] else None
        if completed:
            own = [(job.labels, answers[k]) for k, (s, job) in enumerate(jobs) if s is section]
            write_section(folder, section, study, section.judge(own))
            write_page(folder, SECTIONS)
        tell(Progress(done, len(jobs), completed, seconds[section.name]))
    write_page(folder, SECTIONS)
    return [section.name for section in todo]


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """What a call returned and the CPU time that it took, s."""
    before = time.process_time()
    answer = function(*arguments)
    return answer, time.process_time() - before
