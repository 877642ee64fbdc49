"""The stages of training as they are run, each in its own folder, where it resumes.

`train_all` runs those that make the shipped files, `train_ablation` runs stage 3, and `tune` stage 2 on
other actuators.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs

from . import loop, process_group, recipe
from .constrained import ConstrainedConfig, ConstrainedRun
from .dagger import DaggerConfig, DaggerRun, export_policy, load_policy
from .estimator import EstimatorConfig, EstimatorRun
from .loop import Budget
from .privileged import PrivilegedConfig, PrivilegedRun
from .run_folder import EvaluatedPolicies, training_record, write_run_file
from .teacher_walks import WalkLog

RECIPES = Path(__file__).parents[1] / "recipes"
TEACHER_PARTS = ("privileged", "privileged_rough")  # recipes, in order
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
    """Run stage 1.

    Args:
        config: configuration.
        source: recipe file, for the record.
        folder: run directory.

    Returns:
        Whether the budget is spent.
    """
    run = PrivilegedRun(config)
    write_run_file(folder, "privileged", source, config)
    return loop.train(run, config.budget, folder / TEACHER, WalkLog(run, folder))


def train_student(
    config: DaggerConfig, source: Path | None, teacher: Path, folder: Path, start: Path | None = None
) -> bool:
    """Run stage 2, and write the policy file, also after an interruption.

    Args:
        config: configuration.
        source: recipe file, for the record.
        teacher: checkpoint of stage 1.
        folder: run directory.
        start: checkpoint of stage 2 whose weights a new run starts from; None for random ones.

    Returns:
        Whether the budget is spent.
    """
    run, checkpoint = DaggerRun(config, teacher), folder / STUDENT
    if start is not None:
        run.start_from(start)
    write_run_file(folder, "dagger", source, config)
    spent = loop.train(run, config.budget, checkpoint)
    if process_group.rank() == 0:
        about = training_record("dagger", source, config, checkpoint)
        export_policy(run.average, run.env, config.grid.answered, folder / POLICY_FILE, about)
    return spent


def train_policy(
    config: ConstrainedConfig,
    source: Path | None,
    start: Path,
    teacher: Path | None,
    folder: Path,
    device: str,
) -> bool:
    """Run stage 3, and write the policy file, also after an interruption.

    Args:
        config: configuration.
        source: recipe file, for the record.
        start: checkpoint of stage 2 or 3.
        teacher: checkpoint of stage 1; None for no pull.
        folder: run directory.
        device: `cpu` or `cuda`.

    Returns:
        Whether the budget is spent.
    """
    run, checkpoint = ConstrainedRun(config, start, teacher, device), folder / POLICY
    write_run_file(folder, "constrained", source, config)
    spent = loop.train(run, config.budget, checkpoint, EvaluatedPolicies(run, folder))
    if process_group.rank() == 0:
        run.write_policy(folder / POLICY_FILE, training_record("constrained", source, config, checkpoint))
    return spent


def train_estimator(config: EstimatorConfig, source: Path | None, policy: Path, folder: Path) -> bool:
    """Train the velocity estimator, and write its file, also after an interruption.

    Args:
        config: configuration.
        source: recipe file, for the record.
        policy: checkpoint of stage 2 or 3, whose walks it learns from.
        folder: run directory.

    Returns:
        Whether the budget is spent.
    """
    run, checkpoint = EstimatorRun(config, load_policy(policy)), folder / ESTIMATOR
    write_run_file(folder, "estimator", source, config)
    spent = loop.train(run, config.budget, checkpoint)
    if process_group.rank() == 0:
        run.export(folder / ESTIMATOR_FILE, training_record("estimator", source, config, checkpoint))
    return spent


def train_all(out: Path) -> bool:
    """Train a policy that trots, and its estimator, from random weights, with the recipes of the project.

    It resumes where it was stopped.

    Args:
        out: folder for the run directories.

    Returns:
        Whether all stages are done.
    """
    teacher, student, estimator = (out / name for name in ("privileged", "dagger", "estimator"))
    for part in TEACHER_PARTS:
        if not train_teacher(*_recipe(PrivilegedConfig, part), teacher):
            return False
    if not train_student(*_recipe(DaggerConfig, "dagger"), teacher / TEACHER, student):
        return False
    return train_estimator(*_recipe(EstimatorConfig, "estimator"), student / STUDENT, estimator)


def _recipe(kind: type[Any], name: str) -> tuple[Any, Path]:
    """Read a recipe of the project as a configuration of `kind`; return it with its file."""
    source = RECIPES / f"{name}.yaml"
    return recipe.read_recipe(kind, source), source


def train_ablation(
    start: Path, teacher: Path, samples: float, robots: int, seed: int, out: Path, device: str
) -> bool:
    """Train the three recipes of the ablation from one start; resumes where it was stopped.

    Args:
        start: checkpoint of stage 2.
        teacher: checkpoint of stage 1.
        samples: budget of each recipe.
        robots: number of robots.
        seed: seed of all draws.
        out: folder; policies are OUT/RECIPE/policy.onnx.
        device: `cpu` or `cuda`.

    Returns:
        Whether all recipes are done.
    """
    for name in ABLATION:
        config, source = _recipe(ConstrainedConfig, name)
        config = attrs.evolve(scale_budget(config, samples), n=robots, seed=seed)
        if not train_policy(config, source, start, teacher, out / name, device):
            return False
    return True


def scale_budget(config: ConstrainedConfig, samples: float) -> ConstrainedConfig:
    """Change the budget of a run, and its schedules in proportion.

    Args:
        config: configuration.
        samples: new budget.

    Returns:
        The configuration with this budget.
    """
    share = samples / config.budget.samples
    scheduled = ("std_samples", "pull_samples", "constraint_samples")
    return attrs.evolve(
        config,
        budget=Budget(samples, NO_LIMIT),
        **{name: share * getattr(config, name) for name in scheduled},
    )


def tune(drives: Path, start: Path, teacher: Path, minutes: float, out: Path) -> Path:
    """Let a policy imitate its teacher on the actuators of a file, for a short while.

    Args:
        drives: actuator file.
        start: checkpoint of stage 2.
        teacher: checkpoint of stage 1.
        minutes: duration.
        out: run directory.

    Returns:
        The policy file, written also after an interruption.
    """
    config, source = _recipe(DaggerConfig, "tune")
    budget = attrs.evolve(config.budget, minutes=minutes)
    train_student(attrs.evolve(config, actuator=str(drives), budget=budget), source, teacher, out, start)
    return out / POLICY_FILE
