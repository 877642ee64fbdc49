"""Stage 3 as it is run: a recipe from a start, the ablation's three recipes, and tuning on a corrected actuator model."""

from __future__ import annotations

from pathlib import Path

import attrs

from quadvel_actuator import ActuatorParameters

from . import distill, loop, parallel, recipe, student
from .command_map import CommandMap
from .crl import CrlConfig, CrlRun
from .loop import Budget
from .randomisation import actuator
from .run_folder import Evaluated, describe, made_of

RECIPES = Path(__file__).parents[1] / "recipes"
ABLATION = ("rl_pd", "rl_eam", "crl_eam")
TUNE = RECIPES / "tune.yaml"
CHECKPOINT = "crl.pt"
NO_LIMIT = 1e6  # minutes


def is_student(checkpoint: Path) -> bool:
    """Is this a checkpoint of stage 2?"""
    return "student" in loop.load(checkpoint)


def policy_of(checkpoint: Path) -> student.Policy:
    """The recurrent policy in a checkpoint of stage 2 or 3."""
    content = loop.load(checkpoint)
    if "student" in content:
        return student.actor_of(content["student"])
    prefix = "network."
    return student.actor_of(
        {k.removeprefix(prefix): v for k, v in content["actor"].items() if k.startswith(prefix)}
    )


def learn(config: CrlConfig, source: Path | None, start: Path | None, folder: Path, device: str) -> bool:
    """Train in `folder` from the checkpoint `start`, its critic included; whether the budget is spent.

    `source`: the recipe file, for the record.
    """
    run = CrlRun(config, policy_of(start) if start else None, device)
    if start and (critic := loop.load(start).get("critic")):
        run.critic.load_state_dict(critic)
    if parallel.rank() == 0:
        describe(folder, "crl", source, config)
    return loop.train(run, config.budget, folder / CHECKPOINT, Evaluated(run, folder))


def map_of(checkpoint: Path) -> CommandMap:
    """The command map in a checkpoint of stage 2 or 3; one that adds nothing where there is none."""
    weights = loop.load(checkpoint).get("command_map")
    return CommandMap(None if weights is None else weights.numpy())


def export_student(config: distill.DistillConfig, source: Path | None, checkpoint: Path, out: Path) -> None:
    """The policy file of a checkpoint of stage 2 within the recipe's `limits`, behind its command map, measured anew."""
    about = made_of("distill", source, config, checkpoint)
    drives = ActuatorParameters.default()
    distill.export_mapped(policy_of(checkpoint), map_of(checkpoint), config.limits, drives, about, out)


def export(config: CrlConfig, source: Path | None, checkpoint: Path, out: Path) -> None:
    """The policy file of a checkpoint, behind its command map, which is measured anew on the recipe's actuators."""
    actor, own = policy_of(checkpoint), map_of(checkpoint)
    about = made_of("crl", source, config, checkpoint)
    distill.export_mapped(actor, own, config.commands, actuator(config.actuator), about, out)


def ablation(start: Path, samples: float, out: Path, device: str) -> bool:
    """Train the three recipes from one start, `samples` each, one after the other; `out` gets NAME.onnx of each.

    Goes on where it was stopped; whether all are done.
    """
    for name in ABLATION:
        source = RECIPES / f"{name}.yaml"
        config = attrs.evolve(recipe.read(CrlConfig, source), budget=Budget(samples, NO_LIMIT))
        checkpoint, policy = out / name / CHECKPOINT, out / f"{name}.onnx"
        if policy.exists() and loop.load(checkpoint)["samples"] >= samples:
            continue
        if not learn(config, source, start, out / name, device):
            return False
        if parallel.rank() == 0:
            export(config, source, checkpoint, policy)
    return True


def tune(drives: Path, start: Path, minutes: float, out: Path, device: str) -> Path:
    """Tune the policy of a checkpoint on the actuators of a file; the policy file, exported also where it was stopped.

    In 0 minutes only its command map is measured on them.
    """
    config = recipe.read(CrlConfig, TUNE)
    budget = attrs.evolve(config.budget, minutes=minutes)
    config = attrs.evolve(config, actuator=str(drives), budget=budget)
    if minutes > 0:
        learn(config, TUNE, start, out, device)
    if parallel.rank() == 0:
        export(config, TUNE, out / CHECKPOINT if minutes > 0 else start, out / "tuned.onnx")
    return out / "tuned.onnx"
