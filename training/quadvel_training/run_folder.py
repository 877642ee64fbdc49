"""Content of a run directory: what was run, and policies kept on the way with their evaluations.

run.json: stage, recipe, configuration, commit. kept/: checkpoints, their policy files and
evaluations.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cattrs
from typing_extensions import override

from quadvel_description.robot import load_robot
from quadvel_eval.grid import grid_cells, run_cell, run_stance, summarise
from quadvel_eval.pool import Call, run_in_parallel
from quadvel_eval.report import write_json
from quadvel_eval.walk import Setup

from . import loop, process_group
from .constrained import ConstrainedRun
from .onnx_file import commit
from .randomisation import ACTUATORS, load_actuator

COMMANDS = grid_cells("quick", seeds=1)[::4]  # 14 of 54, with every pair of vy and wz; one minute on one core


def write_run_file(folder: Path, stage: str, recipe: Path | None, config: Any) -> None:
    """Write run.json; a resumed run overwrites it. Only the first process writes.

    Args:
        folder: run directory.
        stage: name of the stage.
        recipe: recipe file, if any.
        config: configuration, an attrs instance.
    """
    if process_group.rank() > 0:
        return
    folder.mkdir(parents=True, exist_ok=True)
    about = {"stage": stage, "recipe": recipe.stem if recipe else None, "commit": commit()}
    write_json(folder / "run.json", about | {"configuration": cattrs.unstructure(config)})


def training_record(stage: str, recipe: Path | None, config: Any, checkpoint: Path) -> dict[str, Any]:
    """Describe how a network was trained, for the metadata of its file.

    An actuator file is reduced to its name: its folder means nothing to others.

    Args:
        stage: name of the stage.
        recipe: recipe file, if any.
        config: configuration, an attrs instance.
        checkpoint: checkpoint of the run.

    Returns:
        Stage, recipe, samples, configuration, and hours of training if the checkpoint has them.
    """
    content, configuration = loop.load(checkpoint), cattrs.unstructure(config)
    if "actuator" in configuration:
        configuration["actuator"] = Path(configuration["actuator"]).name
    hours = round(content["seconds"] / 3600, 2) if "seconds" in content else None
    about = {
        "stage": stage,
        "recipe": recipe.stem if recipe else None,
        "samples": content["samples"],
        "hours": hours,
    }
    return about | {"configuration": configuration}


class EvaluatedPolicies(loop.Keeper):
    """Keeper of policies, evaluated on a quarter of the quick grid with one seed.

    The drives are the best known ones: those of an actuator file if the run has one, else Table 4.
    """

    def __init__(self, run: ConstrainedRun, folder: Path) -> None:
        """Keep the policies of a run.

        Args:
            run: training run.
            folder: run directory.
        """
        super().__init__(run.config.keep)
        self.run, self.folder = run, folder

    @override
    def keep(self) -> dict[str, float]:
        """Checkpoint, policy file and evaluation; falls and errors (m/s) for the curves."""
        run = self.run
        kept = self.folder / "kept" / f"{run.samples // 1000:06}k"
        loop.save(run.state(), kept.with_suffix(".pt"))
        policy = kept.with_suffix(".onnx")
        run.write_policy(policy, {"samples": run.samples})
        name = run.config.actuator
        plant = {} if name in ACTUATORS else {"actuator": load_actuator(load_robot(run.config.robot), name)}
        found = _evaluate(Setup(robot=run.config.robot, policy=policy, plant=plant))
        write_json(kept.with_suffix(".json"), found)
        figures = ("falls", "mean_error_xy", "max_error_xy")
        return {f"eval_{name}": float(found[name]) for name in figures}


def _evaluate(setup: Setup) -> dict[str, Any]:
    """Evaluate as `quadvel eval` does, with few commands."""
    calls: list[Call] = [(run_cell, setup, cell, ()) for cell in COMMANDS]
    answers = dict(run_in_parallel([*calls, (run_stance, setup, 0)]))
    return summarise([answers[i] for i in range(len(calls))], [answers[len(calls)]])
