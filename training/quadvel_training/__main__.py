"""`python -m quadvel_training`: the stages of training, each resumable, and what makes policy files of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import attrs
import cattrs
import torch
import typer
import yaml
from rich.progress import Progress, TextColumn

from quadvel_estimator.kalman import KalmanConfig

from . import crl, distill, env, estimator, kalman_tuning, loop, student, teacher

app = typer.Typer(
    no_args_is_help=True,
    help="Train quadvel's policy and estimator. The order: teacher, distill, crl, export, estimator. Every run resumes where "
    "its directory stands; Ctrl-C saves.",
)

Out = Annotated[Path, typer.Option(help="Run directory: checkpoint, TensorBoard curves, ONNX.")]
Recipe = Annotated[
    Path | None, typer.Option(help="YAML file whose fields replace the defaults; see training/recipes.")
]
Minutes = Annotated[float | None, typer.Option(help="Stop after this long.")]


def _configured(kind: type[Any], recipe: Path | None, minutes: float | None) -> Any:
    """A configuration of `kind` from its defaults, the recipe's fields and the command line's budget."""
    fields = yaml.safe_load(recipe.read_text()) if recipe else {}
    fields = {key: value for key, value in (fields or {}).items() if key != "stage"}
    converter = cattrs.Converter(forbid_extra_keys=True)
    try:
        config = converter.structure(fields, kind)
    except cattrs.BaseValidationError as error:
        raise typer.BadParameter(f"{recipe}: " + "; ".join(cattrs.transform_error(error))) from None
    if minutes is not None:
        config = attrs.evolve(config, budget=attrs.evolve(config.budget, minutes=minutes))
    return config


def _actor(path: Path) -> Any:
    """A recurrent policy from a checkpoint of `distill` or `crl`."""
    content = loop.load(path)
    actor = student.new_actor()
    if "student" in content:
        actor.load_state_dict(content["student"])
    else:
        weights = {
            k.removeprefix("network."): v for k, v in content["actor"].items() if k.startswith("network.")
        }
        actor.load_state_dict(weights)
    return actor


def _recipe(config: Any, run: Any, stage: str) -> dict[str, Any]:
    return {"stage": stage, "samples": run.samples, "configuration": attrs.asdict(config)}


@app.command("teacher")
def train_teacher(
    out: Out = Path("out/training/teacher"), recipe: Recipe = None, minutes: Minutes = None
) -> None:
    """Stage 1: the teacher with a clock and the true state."""
    config = _configured(teacher.TeacherConfig, recipe, minutes)
    loop.train(teacher.TeacherRun(config), config.budget, out / "teacher.pt")


@app.command("distill")
def train_student(
    teacher_file: Annotated[Path, typer.Option("--teacher")] = Path("out/training/teacher/teacher.pt"),
    start: Annotated[Path | None, typer.Option(help="Checkpoint of a student to refine.")] = None,
    out: Out = Path("out/training/student"),
    recipe: Recipe = None,
    minutes: Minutes = None,
) -> None:
    """Stage 2: the recurrent student learns from the teacher."""
    config = _configured(distill.DistillConfig, recipe, minutes)
    run = distill.DistillRun(config, teacher_file, _actor(start) if start else None)
    loop.train(run, config.budget, out / "student.pt")
    student.export_policy(run.student, run.env, out / "policy.onnx", _recipe(config, run, "distill"))


@app.command("crl")
def train_crl(
    start: Annotated[
        Path | None, typer.Option(help="Checkpoint of a student; without it, random weights.")
    ] = None,
    out: Out = Path("out/training/crl"),
    recipe: Recipe = None,
    minutes: Minutes = None,
) -> None:
    """Stage 3: constrained reinforcement learning with the rewards of Table 2."""
    config = _configured(crl.CrlConfig, recipe, minutes)
    run = crl.CrlRun(config, _actor(start) if start else None)
    loop.train(run, config.budget, out / "crl.pt")
    recipe_of = _recipe(config, run, "crl")
    student.export_policy(run.actor.network, run.env, out / "policy.onnx", recipe_of, run.command_map)


@app.command("export")
def export_policy(
    checkpoint: Annotated[Path, typer.Argument(help="Of `distill` or `crl`.")],
    out: Annotated[Path, typer.Option(help="The policy file to write.")] = Path("out/training/crl_eam.onnx"),
    recipe: Recipe = None,
) -> None:
    """A policy file of a checkpoint, behind a command map that takes out its steady-state error."""
    config = _configured(crl.CrlConfig, recipe, None)
    actor = _actor(checkpoint)
    command_map, walks = distill.student_map(actor, config.commands)
    made_of = {
        "stage": "crl",
        "samples": loop.load(checkpoint)["samples"],
        "configuration": attrs.asdict(config),
    }
    student.export_policy(actor, walks, out, made_of, command_map)
    print(f"written: {out}")


@app.command("estimator")
def train_estimator(
    policy: Annotated[Path, typer.Option(help="Checkpoint of the policy whose walks it learns on.")] = Path(
        "out/training/student/student.pt"
    ),
    out: Out = Path("out/training/estimator"),
    recipe: Recipe = None,
    minutes: Minutes = None,
) -> None:
    """The linear-velocity estimator, on the policy's own walks."""
    config = _configured(estimator.EstimatorConfig, recipe, minutes)
    run = estimator.EstimatorRun(config, _actor(policy))
    loop.train(run, config.budget, out / "estimator.pt")
    run.export(out / "estimator.onnx", _recipe(config, run, "estimator"))


@app.command("kalman")
def tune_kalman(
    policy: Annotated[Path, typer.Option(help="Checkpoint of the policy whose walks it is tuned on.")] = Path(
        "out/training/student/student.pt"
    ),
    recipe: Recipe = None,
) -> None:
    """Tune the Kalman filter's noise on the same kind of walks; prints what belongs into `KalmanConfig`."""
    config = _configured(kalman_tuning.TuningConfig, recipe, None)
    recording = kalman_tuning.record(config, _actor(policy))
    before = kalman_tuning.rmse(KalmanConfig(), recording)
    with Progress(*Progress.get_default_columns(), TextColumn("{task.fields[error]}")) as progress:
        task = progress.add_task("kalman", total=config.evaluations, error="")
        tuned = kalman_tuning.tune(
            recording,
            config.evaluations,
            lambda error: progress.update(task, advance=1, error=f"{error.mean():.4f} m/s"),
        )
    for name, error in (("before", before), ("after", kalman_tuning.rmse(tuned, recording))):
        print(f"{name}: RMSE flat {error[0].round(3)}, rough {error[1].round(3)} m/s")
    for name in tuned.bounds():
        print(f"{name}: {getattr(tuned, name):.3g}")


if __name__ == "__main__":
    torch.set_num_threads(env.cores())
    app()
