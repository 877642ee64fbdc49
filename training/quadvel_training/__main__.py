"""`python -m quadvel_training`: the stages of training, each resumable, and what makes policy files and their cards of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import attrs
import torch
import typer
from rich.progress import Progress, TextColumn

from quadvel_actuator.parameters import ActuatorParameters
from quadvel_estimator.kalman import KalmanConfig
from quadvel_eval.paper import gap
from quadvel_policy.policy_file import SHIPPED_POLICY

from . import (
    constrained,
    crl,
    dagger,
    distill,
    env,
    estimator,
    kalman_tuning,
    leg_classifier,
    loop,
    parallel,
    privileged,
    recipe,
    run_folder,
    stage3,
    teacher,
)
from .card import card

app = typer.Typer(
    no_args_is_help=True,
    help="Train quadvel's policy and estimator. The order: teacher, distill, crl, export, estimator, card; `ablation` and `tune` "
    "run stage 3 with recipes of their own. Every run resumes where its directory stands; Ctrl-C saves.",
)

Out = Annotated[
    Path, typer.Option(help="Run directory: configuration, checkpoint, TensorBoard curves, ONNX.")
]
Recipe = Annotated[
    Path | None,
    typer.Option(
        "--recipe", help="YAML file whose fields replace the defaults; see training/recipes.", dir_okay=False
    ),
]
Minutes = Annotated[float | None, typer.Option(help="Stop after this long.")]
Device = Annotated[str, typer.Option(help="Where networks are: cpu or cuda. Physics stays on the CPU.")]
START = Path("training/checkpoints/student.pt")


def _configured(kind: type[Any], source: Path | None, minutes: float | None) -> Any:
    """A configuration of `kind` from its defaults, the recipe's fields and the command line's budget."""
    config = recipe.read(kind, source)
    if minutes is not None:
        config = attrs.evolve(config, budget=attrs.evolve(config.budget, minutes=minutes))
    return config


@app.command("teacher")
def train_teacher(
    out: Out = Path("out/training/teacher"), source: Recipe = None, minutes: Minutes = None
) -> None:
    """Stage 1: the teacher with a clock and the true state."""
    config = _configured(teacher.TeacherConfig, source, minutes)
    run_folder.describe(out, "teacher", source, config)
    loop.train(teacher.TeacherRun(config), config.budget, out / "teacher.pt")


@app.command("privileged")
def train_privileged(
    out: Out = Path("out/training/privileged"), source: Recipe = None, minutes: Minutes = None
) -> None:
    """Stage 1 without a clock: a memoryless teacher finds its gait from random weights, by rewards alone.

    Numbered checkpoints go to DIR/kept; any of them, copied to DIR/privileged.pt, is where the same command goes on from.
    """
    config = _configured(privileged.PrivilegedConfig, source, minutes)
    run_folder.describe(out, "privileged", source, config)
    run = privileged.PrivilegedRun(config)
    loop.train(run, config.budget, out / "privileged.pt", privileged.Numbered(run, out))


@app.command("dagger")
def train_dagger(
    teacher_file: Annotated[
        Path, typer.Option("--teacher", help="Checkpoint of `privileged`, a numbered one too.")
    ] = Path("out/training/privileged/privileged.pt"),
    out: Out = Path("out/training/dagger"),
    source: Recipe = None,
    minutes: Minutes = None,
) -> None:
    """Stage 2 without a clock: the paper's plain network learns from that teacher while it drives itself.

    Writes DIR/policy.onnx; `quadvel eval --policy DIR/policy.onnx` says how it walks.
    """
    config = _configured(dagger.DaggerConfig, source, minutes)
    run_folder.describe(out, "dagger", source, config)
    run = dagger.DaggerRun(config, teacher_file)
    checkpoint = out / "dagger.pt"
    loop.train(run, config.budget, checkpoint)
    about = run_folder.made_of("dagger", source, config, checkpoint)
    dagger.export_policy(run.student, run.env, run.grid, out / "policy.onnx", about)
    print(f"written: {out / 'policy.onnx'}")


@app.command("constrained")
def train_constrained(
    start: Annotated[Path, typer.Option(help="Checkpoint of `dagger`.")] = Path(
        "out/training/dagger/dagger.pt"
    ),
    teacher_file: Annotated[
        Path, typer.Option("--teacher", help="Checkpoint of `privileged`, which pulls at first.")
    ] = Path("out/training/privileged/privileged.pt"),
    out: Out = Path("out/training/constrained"),
    source: Recipe = None,
    minutes: Minutes = None,
    device: Device = "cpu",
) -> None:
    """Stage 3 without a clock: constrained reinforcement learning of the plain network, from the student of `dagger`.

    Writes DIR/policy.onnx; on the way, policies and what a quick evaluation says of them go to DIR/kept.
    """
    config = _configured(constrained.ConstrainedConfig, source, minutes)
    run = constrained.ConstrainedRun(config, start, teacher_file, device)
    checkpoint = out / "constrained.pt"
    if parallel.rank() == 0:
        run_folder.describe(out, "constrained", source, config)
    loop.train(run, config.budget, checkpoint, run_folder.Evaluated(run, out))
    if parallel.rank() == 0:
        run.write_policy(out / "policy.onnx", run_folder.made_of("constrained", source, config, checkpoint))
        print(f"written: {out / 'policy.onnx'}")


@app.command("distill")
def train_student(
    teacher_file: Annotated[Path, typer.Option("--teacher")] = Path("out/training/teacher/teacher.pt"),
    start: Annotated[Path | None, typer.Option(help="Checkpoint of a student to refine.")] = None,
    out: Out = Path("out/training/student"),
    source: Recipe = None,
    minutes: Minutes = None,
) -> None:
    """Stage 2: the recurrent student learns from the teacher."""
    config = _configured(distill.DistillConfig, source, minutes)
    run_folder.describe(out, "distill", source, config)
    run = distill.DistillRun(config, teacher_file, stage3.policy_of(start) if start else None)
    checkpoint = out / "student.pt"
    loop.train(run, config.budget, checkpoint)
    stage3.export_student(config, source, checkpoint, out / "policy.onnx")


@app.command("crl")
def train_crl(
    start: Annotated[
        Path | None, typer.Option(help="Checkpoint of a student; without it, random weights.")
    ] = None,
    out: Out = Path("out/training/crl"),
    source: Recipe = None,
    minutes: Minutes = None,
    device: Device = "cpu",
) -> None:
    """Stage 3: constrained reinforcement learning with the rewards of Table 2.

    With torchrun, several processes or machines learn together: torchrun --nproc-per-node 2 -m -- quadvel_training crl ...
    """
    stage3.learn(_configured(crl.CrlConfig, source, minutes), source, start, out, device)


@app.command("export")
def export_policy(
    checkpoint: Annotated[Path, typer.Argument(help="Of `distill` or `crl`.")],
    out: Annotated[Path, typer.Option(help="The policy file to write.")] = Path("out/training/crl_eam.onnx"),
    source: Recipe = None,
) -> None:
    """A policy file of a checkpoint, behind a command map that takes out its steady-state error.

    The recipe is that of the checkpoint's stage: it says which commands the file answers.
    """
    if stage3.is_student(checkpoint):
        stage3.export_student(recipe.read(distill.DistillConfig, source), source, checkpoint, out)
    else:
        stage3.export(recipe.read(crl.CrlConfig, source), source, checkpoint, out)
    print(f"written: {out}")


@app.command("ablation")
def train_ablation(
    start: Annotated[Path, typer.Option(help="Checkpoint that all three start from.")] = START,
    samples: Annotated[float, typer.Option(help="Of each recipe, the budget that is equal for all.")] = 6e7,
    out: Annotated[Path, typer.Option(help="Folder for the runs and their policy files.")] = Path(
        "out/ablation"
    ),
    device: Device = "cpu",
) -> None:
    """Train rl_pd, rl_eam and crl_eam from one start, one after the other; goes on where it was stopped.

    \b
    Then:
      quadvel paper --out out/ablation/paper --policy rl_pd=out/ablation/rl_pd.onnx \\
        --policy rl_eam=out/ablation/rl_eam.onnx --policy crl_eam=out/ablation/crl_eam.onnx
    """
    if not stage3.ablation(start, samples, out, device):
        raise typer.Exit(1)
    print(f"written: {', '.join(f'{out}/{name}.onnx' for name in stage3.ABLATION)}")


def _actuator_file(path: Path) -> Path:
    try:
        ActuatorParameters.load(path)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    return path


@app.command("tune")
def tune_policy(
    actuator: Annotated[
        Path,
        typer.Option(help="Actuator file of `quadvel identify`.", exists=True, callback=_actuator_file),
    ],
    policy: Annotated[Path, typer.Option(help="Checkpoint to start from.", exists=True)] = START,
    minutes: Annotated[
        float,
        typer.Option(
            min=0.0,
            help="How long; counts anew where it is resumed. 0: measure its command map, learn nothing.",
        ),
    ] = 20.0,
    out: Out = Path("out/tuned"),
    device: Device = "cpu",
) -> None:
    """Tune a policy on a corrected actuator model for a short while: DIR/tuned.onnx, with a command map of its own.

    \b
    Before and after, on the plants of the gap:
      quadvel paper --out out/gap --only gap --policy before=BEFORE.onnx --policy after=DIR/tuned.onnx
    """
    print(f"written: {stage3.tune(actuator, policy, minutes, out, device)}")


@app.command("record")
def record_log(
    plant: Annotated[
        str, typer.Option(help=f"One of the gap's: {', '.join(p.level for p in gap.plants())}.")
    ],
    out: Annotated[Path, typer.Option(help="NPZ file for `quadvel identify`.")],
    policy: Annotated[Path, typer.Option(help="Policy file that walks.", exists=True)] = SHIPPED_POLICY,
) -> None:
    """Record a walk on a plant whose drives hold what training never saw, as a log for `quadvel identify`."""
    try:
        gap.record_walk(policy, plant, out)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    print(f"written: {out}")


@app.command("estimator")
def train_estimator(
    policy: Annotated[Path, typer.Option(help="Checkpoint of the policy whose walks it learns on.")] = Path(
        "out/training/student/student.pt"
    ),
    out: Out = Path("out/training/estimator"),
    source: Recipe = None,
    minutes: Minutes = None,
) -> None:
    """The linear-velocity estimator, on the policy's own walks."""
    config = _configured(estimator.EstimatorConfig, source, minutes)
    run_folder.describe(out, "estimator", source, config)
    run = estimator.EstimatorRun(config, stage3.policy_of(policy))
    checkpoint = out / "estimator.pt"
    loop.train(run, config.budget, checkpoint)
    run.export(out / "estimator.onnx", run_folder.made_of("estimator", source, config, checkpoint))


@app.command("kalman")
def tune_kalman(
    policy: Annotated[Path, typer.Option(help="Checkpoint of the policy whose walks it is tuned on.")] = Path(
        "out/training/student/student.pt"
    ),
    source: Recipe = None,
) -> None:
    """Tune the Kalman filter's noise on the same kind of walks; prints what belongs into `KalmanConfig`."""
    config = recipe.read(kalman_tuning.TuningConfig, source)
    recording = kalman_tuning.record(config, stage3.policy_of(policy))
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


Scans = Annotated[Path, typer.Option(help="Folder with files legs_*.npz of real scans.", file_okay=False)]


@app.command("legs")
def train_legs(scans: Scans, out: Out = Path("out/training/legs"), source: Recipe = None) -> None:
    """The network that tells legs in laser scans, on real and simulated ones: DIR/legs.onnx; minutes."""
    config = recipe.read(leg_classifier.LegConfig, source)
    run_folder.describe(out, "legs", source, config)
    real, made = leg_classifier.read_examples(config, scans)
    network = leg_classifier.train(config, list(real.values()), made)
    about = {"files": [file.name for file in real], "configuration": attrs.asdict(config)}
    leg_classifier.export(network, out / "legs.onnx", about)
    print(f"written: {out / 'legs.onnx'}")


@app.command("legs-left-out")
def cross_validate_legs(scans: Scans, source: Recipe = None) -> None:
    """How well that network does on each file of scans when it has learned from the others alone."""
    config = recipe.read(leg_classifier.LegConfig, source)
    for name, figures in leg_classifier.cross_validate(config, *leg_classifier.read_examples(config, scans)):
        print(
            f"{name}: " + ", ".join(f"{figure} {value:.3g}" for figure, value in figures.items()), flush=True
        )


@app.command("card")
def write_card(
    network: Annotated[Path, typer.Argument(help="Policy or estimator file.")],
    evaluations: Annotated[
        list[Path], typer.Argument(help="eval.json of `quadvel eval`, or the folder it is in; one or more.")
    ],
) -> None:
    """The model card of a network, written beside it: FILE.md of FILE.onnx."""
    path = network.with_suffix(".md")
    path.write_text(card(network, evaluations))
    print(f"written: {path}")


def main() -> None:
    """The program; what is wrong with a file is told in one sentence."""
    torch.set_num_threads(env.cores())
    try:
        app()
    except (recipe.RecipeError, FileNotFoundError) as error:
        raise SystemExit(f"quadvel_training: {error}") from None


if __name__ == "__main__":
    main()
