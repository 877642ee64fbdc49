"""What a run directory holds beside curves and checkpoint: what was run, and the policies kept on the way with their figures.

run.json: stage, recipe, configuration, commit. kept/: a checkpoint, its policy file and its evaluation every some samples.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cattrs

from quadvel_eval.grid import grid_cells, run_cell, run_stance, summarise
from quadvel_eval.pool import Call, run_in_parallel
from quadvel_eval.report import write_json
from quadvel_eval.walk import Setup

from . import loop, parallel
from .constrained import ConstrainedRun
from .onnx_file import commit
from .randomisation import ACTUATORS, actuator

COMMANDS = grid_cells("quick", seeds=1)[::4]  # 14 of 54, with every pair of vy and wz: a minute of one core


def describe(folder: Path, stage: str, recipe: Path | None, config: Any) -> None:
    """Write run.json: what this directory's run is; where it is resumed, what it is from now on. One process does."""
    if parallel.rank() > 0:
        return
    folder.mkdir(parents=True, exist_ok=True)
    about = {"stage": stage, "recipe": recipe.stem if recipe else None, "commit": commit()}
    write_json(folder / "run.json", about | {"configuration": cattrs.unstructure(config)})


def made_of(stage: str, recipe: Path | None, config: Any, checkpoint: Path) -> dict[str, Any]:
    """How a network came to be, for the metadata of its file; hours of training where the checkpoint knows them.

    An actuator file is told by its name: where it lay says nothing to those whom the network is handed to.
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


class Evaluated(loop.Keeper):
    """Keeps the run's policy every so many samples and evaluates it on a quarter of the quick grid, one seed.

    On the drives as they are known best: those of an actuator file where the run has one, else Table 4.
    """

    def __init__(self, run: ConstrainedRun, folder: Path) -> None:
        super().__init__(run.config.keep)
        self.run, self.folder = run, folder

    def keep(self) -> dict[str, float]:
        """Checkpoint, policy file and evaluation; falls and errors (m/s) for the curves."""
        run = self.run
        kept = self.folder / "kept" / f"{run.samples // 1000:06}k"
        loop.save(run.state(), kept.with_suffix(".pt"))
        policy = kept.with_suffix(".onnx")
        run.write_policy(policy, {"samples": run.samples})
        name = run.config.actuator
        plant = {} if name in ACTUATORS else {"actuator": actuator(name)}
        found = _evaluate(Setup(policy=policy, plant=plant))
        write_json(kept.with_suffix(".json"), found)
        figures = ("falls", "mean_error_xy", "max_error_xy")
        return {f"eval_{name}": float(found[name]) for name in figures}


def _evaluate(setup: Setup) -> dict[str, Any]:
    """As `quadvel eval` would have it in its eval.json, with few commands."""
    calls: list[Call] = [(run_cell, setup, cell, ()) for cell in COMMANDS]
    answers = dict(run_in_parallel([*calls, (run_stance, setup, 0)]))
    return summarise([answers[i] for i in range(len(calls))], [answers[len(calls)]])
