"""The stages of training as they are run: each in a folder of its own, where it goes on; all of them one after the other;
stage 3 with the ablation's recipes, and for a short while on a corrected actuator model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs

from . import loop, parallel, recipe
from .constrained import ConstrainedConfig, ConstrainedRun
from .dagger import DaggerConfig, DaggerRun, export_policy, policy_of
from .estimator import EstimatorConfig, EstimatorRun
from .gait_log import GaitLog
from .loop import Budget
from .privileged import PrivilegedConfig, PrivilegedRun
from .run_folder import Evaluated, describe, made_of

RECIPES = Path(__file__).parents[1] / "recipes"
TEACHER_PARTS = ("privileged", "privileged_rough")  # recipes, one after the other
POLICY_PARTS = {"constrained": "crl_eam", "constrained_fine": "crl_eam_fine"}  # folders and recipes, likewise
ABLATION = ("rl_pd", "rl_eam", "crl_eam")
TEACHER, STUDENT, POLICY, ESTIMATOR = (
    "privileged.pt",
    "dagger.pt",
    "constrained.pt",
    "estimator.pt",
)  # checkpoints
POLICY_FILE, ESTIMATOR_FILE = "policy.onnx", "estimator.onnx"
NO_LIMIT = 1e6  # minutes


def train_teacher(config: PrivilegedConfig, source: Path | None, folder: Path) -> bool:
    """Stage 1; whether its budget is spent. source, here and below: the recipe file, for the record."""
    run = PrivilegedRun(config)
    describe(folder, "privileged", source, config)
    return loop.train(run, config.budget, folder / TEACHER, GaitLog(run, folder))


def train_student(config: DaggerConfig, source: Path | None, teacher: Path, folder: Path) -> bool:
    """Stage 2, from a checkpoint of stage 1; the policy file is written where it was stopped, too."""
    run, checkpoint = DaggerRun(config, teacher), folder / STUDENT
    describe(folder, "dagger", source, config)
    spent = loop.train(run, config.budget, checkpoint)
    if parallel.rank() == 0:
        about = made_of("dagger", source, config, checkpoint)
        export_policy(run.student, run.env, config.grid.answered, folder / POLICY_FILE, about)
    return spent


def train_policy(
    config: ConstrainedConfig,
    source: Path | None,
    start: Path,
    teacher: Path | None,
    folder: Path,
    device: str,
) -> bool:
    """Stage 3, from a checkpoint of stage 2 or of its own, pulled by that of the `teacher`; policy file as in stage 2."""
    run, checkpoint = ConstrainedRun(config, start, teacher, device), folder / POLICY
    describe(folder, "constrained", source, config)
    spent = loop.train(run, config.budget, checkpoint, Evaluated(run, folder))
    if parallel.rank() == 0:
        run.write_policy(folder / POLICY_FILE, made_of("constrained", source, config, checkpoint))
    return spent


def train_estimator(config: EstimatorConfig, source: Path | None, policy: Path, folder: Path) -> bool:
    """The velocity estimator on the walks of a checkpoint of stage 2 or 3; its file is written where it was stopped, too."""
    run, checkpoint = EstimatorRun(config, policy_of(policy)), folder / ESTIMATOR
    describe(folder, "estimator", source, config)
    spent = loop.train(run, config.budget, checkpoint)
    if parallel.rank() == 0:
        run.export(folder / ESTIMATOR_FILE, made_of("estimator", source, config, checkpoint))
    return spent


def everything(out: Path, device: str) -> bool:
    """All stages from random weights on, each with its recipe in a folder of `out`; goes on where it was stopped.

    Returns whether all are done.
    """
    teacher, student, estimator = (out / name for name in ("privileged", "dagger", "estimator"))
    for part in TEACHER_PARTS:
        if not train_teacher(*_recipe(PrivilegedConfig, part), teacher):
            return False
    if not train_student(*_recipe(DaggerConfig, "dagger"), teacher / TEACHER, student):
        return False
    start = student / STUDENT
    for folder, part in POLICY_PARTS.items():
        stage3 = _recipe(ConstrainedConfig, part)
        if not train_policy(*stage3, start, teacher / TEACHER, out / folder, device):
            return False
        start = out / folder / POLICY
    return train_estimator(*_recipe(EstimatorConfig, "estimator"), start, estimator)


def _recipe(kind: type[Any], name: str) -> tuple[Any, Path]:
    """A recipe that comes with the project, as a configuration of `kind`, and its file."""
    source = RECIPES / f"{name}.yaml"
    return recipe.read(kind, source), source


def ablation(
    start: Path, teacher: Path, samples: float, robots: int, seed: int, out: Path, device: str
) -> bool:
    """Train the three recipes from one start, `samples` each, one after the other; policies are OUT/RECIPE/policy.onnx.

    Goes on where it was stopped; whether all are done.
    """
    for name in ABLATION:
        config, source = _recipe(ConstrainedConfig, name)
        config = attrs.evolve(within(config, samples), n=robots, seed=seed)
        if not train_policy(config, source, start, teacher, out / name, device):
            return False
    return True


def within(config: ConstrainedConfig, samples: float) -> ConstrainedConfig:
    """The run with another budget: what fades or grows in it does so over the same shares of its samples."""
    share = samples / config.budget.samples
    scheduled = ("std_samples", "pull_samples", "constraint_samples")
    return attrs.evolve(
        config,
        budget=Budget(samples, NO_LIMIT),
        **{name: share * getattr(config, name) for name in scheduled},
    )


def tune(drives: Path, start: Path, minutes: float, out: Path, device: str) -> Path:
    """Tune the policy of a checkpoint on the actuators of a file; the policy file, written where it was stopped, too."""
    config, source = _recipe(ConstrainedConfig, "tune")
    budget = attrs.evolve(config.budget, minutes=minutes)
    train_policy(attrs.evolve(config, actuator=str(drives), budget=budget), source, start, None, out, device)
    return out / POLICY_FILE
