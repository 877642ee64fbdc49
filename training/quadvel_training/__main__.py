"""Command line of training, `python -m quadvel_training`.

It runs the stages, each resumable, and tools for policy files.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any

import attrs
import typer
from rich.progress import Progress, TextColumn

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_bringup.error_sentence import exit_with_sentence
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_estimator.kalman import KalmanConfig
from quadvel_eval.paper import gap
from quadvel_policy.observation import VelocityCommandLimits
from quadvel_policy.policy_file import SHIPPED_POLICY, PolicyFile

try:
    import torch
except ModuleNotFoundError:
    print(
        "quadvel_training needs PyTorch, not installed here: in the checkout, run "
        "pip install -c requirements.lock -e '.[train]'",
        file=sys.stderr,
    )
    raise SystemExit(2) from None

from . import (
    closing,
    constrained,
    dagger,
    env,
    estimator,
    kalman_tuning,
    leg_classifier,
    limiting,
    privileged,
    process_group,
    random_walks,
    recipe,
    run_folder,
    stages,
    teacher_walks,
)
from .card import card

app = typer.Typer(
    no_args_is_help=True,
    help="Train quadvel's policy and estimator. `all` runs the stages in order: privileged, dagger, estimator; "
    "`ablation` runs constrained, on a policy that walks. Ctrl-C saves; the same command resumes. "
    "torchrun trains in several processes, on several machines if these share the directory: "
    "torchrun --nproc-per-node 2 -m -- quadvel_training all",
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
Minutes = Annotated[float | None, typer.Option(help="Time limit, minutes.")]
Device = Annotated[str, typer.Option(help="Device of the networks: cpu or cuda. Physics runs on the CPU.")]
TEACHER = Path("out/training/privileged") / stages.TEACHER
STUDENT = Path("out/training/dagger") / stages.STUDENT
TeacherFile = Annotated[
    Path, typer.Option("--teacher", help="Checkpoint of `privileged`, also a numbered one.", dir_okay=False)
]
PolicyCheckpoint = Annotated[
    Path, typer.Option("--policy", help="Checkpoint of the policy, of `constrained` or `dagger`.")
]


def _configured(kind: type[Any], source: Path | None, minutes: float | None) -> Any:
    """Build a configuration from its defaults, the recipe's fields and the command line's budget."""
    config = recipe.read_recipe(kind, source)
    if minutes is not None:
        config = attrs.evolve(config, budget=attrs.evolve(config.budget, minutes=minutes))
    return config


def _written(*paths: Path) -> None:
    """Print the written files, in the process that wrote them."""
    if process_group.rank() == 0:
        print("written:", *paths)


@app.command("all")
def train_everything(out: Out = Path("out/training")) -> None:
    """Train a policy that trots, and its estimator, from random weights: privileged, dagger, estimator.

    Writes DIR/dagger/policy.onnx and DIR/estimator/estimator.onnx. The same command resumes it.
    """
    if not stages.train_all(out):
        raise typer.Exit(1)
    _written(out / "dagger" / stages.POLICY_FILE, out / "estimator" / stages.ESTIMATOR_FILE)


@app.command("privileged")
def train_privileged(
    out: Out = Path("out/training/privileged"), source: Recipe = None, minutes: Minutes = None
) -> None:
    """Stage 1: train a memoryless teacher from random weights, by rewards alone.

    Numbered checkpoints go to DIR/kept. To resume from one, copy it to DIR/privileged.pt and run the command again.
    """
    stages.train_teacher(_configured(privileged.PrivilegedConfig, source, minutes), source, out)


@app.command("walks")
def walk_teacher(
    teacher: TeacherFile = TEACHER,
    source: Recipe = stages.RECIPES / "privileged.yaml",
    robots: Annotated[int, typer.Option(min=1, help="Number of robots for each command.")] = 16,
) -> None:
    """Let the teacher walk at constant commands, and print falls, velocity and kind of gait.

    Robots are drawn and pushed as the recipe says.
    """
    config = recipe.read_recipe(privileged.PrivilegedConfig, source)
    for one in teacher_walks.walk_drawn_robots(teacher, config, robots):
        print(one.line, flush=True)


@app.command("random-walks")
def walk_randomly(
    teacher: TeacherFile = TEACHER,
    policy: Annotated[
        Path | None,
        typer.Option(help="Checkpoint of `dagger`, which drives instead of the teacher.", exists=True),
    ] = None,
    source: Recipe = stages.RECIPES / "dagger.yaml",
    robots: Annotated[int, typer.Option(min=1, help="Number of nominal robots.")] = 192,
    seconds: Annotated[float, typer.Option(min=1.0, help="Duration of each walk, s.")] = 20.0,
) -> None:
    """Let robots walk under the paper's random commands in raw steps, within the limits of a policy file.

    Prints how many fall, and how many fall or move a joint so fast that the supervisor stops them.
    """
    config = recipe.read_recipe(dagger.DaggerConfig, source)
    found = random_walks.walk_randomly(teacher, policy, config, robots, seconds)
    typer.echo(
        f"{found.robots} robots: {found.fell} fell, {found.stopped} fell or moved a joint beyond the supervisor's limit"
    )


@app.command("dagger")
def train_dagger(
    teacher: TeacherFile = TEACHER,
    out: Out = Path("out/training/dagger"),
    source: Recipe = None,
    minutes: Minutes = None,
) -> None:
    """Stage 2: train the paper's network on the teacher's actions while it drives the robots (DAgger).

    Writes DIR/policy.onnx; evaluate it with `quadvel eval --policy DIR/policy.onnx`.
    """
    stages.train_student(_configured(dagger.DaggerConfig, source, minutes), source, teacher, out)
    _written(out / stages.POLICY_FILE)


@app.command("constrained")
def train_constrained(
    start: Annotated[Path, typer.Option(help="Checkpoint of `dagger`, or of this stage.")] = STUDENT,
    teacher: TeacherFile = TEACHER,
    out: Out = Path("out/training/constrained"),
    source: Recipe = None,
    minutes: Minutes = None,
    device: Device = "cpu",
) -> None:
    """Stage 3: train that network by constrained reinforcement learning, with a pull to the teacher that fades.

    Writes DIR/policy.onnx. Intermediate policies and their quick evaluations go to DIR/kept.
    """
    config = _configured(constrained.ConstrainedConfig, source, minutes)
    stages.train_policy(config, source, start, teacher, out, device)
    _written(out / stages.POLICY_FILE)


@app.command("ablation")
def train_ablation(
    start: Annotated[Path, typer.Option(help="Checkpoint of `dagger` that all three start from.")] = STUDENT,
    teacher: TeacherFile = TEACHER,
    samples: Annotated[float, typer.Option(help="Budget of each recipe, in samples.")] = 6e7,
    robots: Annotated[
        int, typer.Option(min=2, help="Number of robots; fewer mean more and noisier steps.")
    ] = 512,
    seed: Annotated[int, typer.Option(help="Seed of all draws.")] = 3,
    out: Annotated[Path, typer.Option(help="Folder for the runs and their policy files.")] = Path(
        "out/ablation"
    ),
    device: Device = "cpu",
) -> None:
    """Train rl_pd, rl_eam and crl_eam from one start, in order; the same command resumes it.

    Schedules of pull, exploration and constraints scale with the budget.

    \b
    Then:
      quadvel paper --out out/ablation/paper --policy rl_pd=out/ablation/rl_pd/policy.onnx \\
        --policy rl_eam=out/ablation/rl_eam/policy.onnx --policy crl_eam=out/ablation/crl_eam/policy.onnx
    """
    if not stages.train_ablation(start, teacher, samples, robots, seed, out, device):
        raise typer.Exit(1)
    _written(*(out / name / stages.POLICY_FILE for name in stages.ABLATION))


def _actuator_file(path: Path) -> Path:
    """Check an actuator file given as an option: it must fit all joints of the robot."""
    try:
        ActuatorModel(ActuatorParameters.load(load_robot(DEFAULT_ROBOT), path))
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    return path


@app.command("tune")
def tune_policy(
    actuator: Annotated[
        Path,
        typer.Option(help="Actuator file of `quadvel identify`.", exists=True, callback=_actuator_file),
    ],
    policy: Annotated[Path, typer.Option(help="Checkpoint of `dagger`, of the policy.")] = STUDENT,
    teacher: TeacherFile = TEACHER,
    minutes: Annotated[
        float, typer.Option(min=0.1, help="Duration, minutes; starts again when resumed.")
    ] = 20.0,
    out: Out = Path("out/tuned"),
) -> None:
    """Tune a policy on a corrected actuator model for a short time; writes DIR/policy.onnx.

    It imitates its teacher on these actuators, as in stage 2.

    \b
    Compare before and after on the plants of the gap:
      quadvel paper --out out/gap --only gap --policy before=BEFORE.onnx --policy after=DIR/policy.onnx
    """
    _written(stages.tune(actuator, policy, teacher, minutes, out))


Plant = Annotated[
    str,
    typer.Option(help="A plant of the gap, such as backlash or friction; a wrong name lists all of them."),
]
WalkingPolicy = Annotated[Path, typer.Option(help="Policy file that walks.", exists=True)]


@app.command("record")
def record_log(
    plant: Plant,
    out: Annotated[Path, typer.Option(help="NPZ file for `quadvel identify`.")],
    policy: WalkingPolicy = SHIPPED_POLICY,
) -> None:
    """Record a walk on a plant whose drives have an effect that training never saw, as a log for `quadvel identify`."""
    gap.write_walk_log(load_robot(DEFAULT_ROBOT), policy, plant, out)
    _written(out)


@app.command("close-the-loop")
def close_the_loop(
    checkpoint: Annotated[
        Path, typer.Option(help="Checkpoint of `dagger` that POLICY was written from.", exists=True)
    ],
    teacher: Annotated[Path, typer.Option(help="Checkpoint of `privileged`, its teacher.", exists=True)],
    plant: Plant = "friction",
    policy: WalkingPolicy = SHIPPED_POLICY,
    minutes: Annotated[float, typer.Option(min=0.1, help="Duration of the tuning, minutes.")] = 20.0,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("out/loop"),
) -> None:
    """Record a walk on a plant that training never saw, correct the model, tune the policy on it, and compare.

    Runs `record`, `quadvel identify`, `tune` and `quadvel paper --only gap`; existing files are kept.
    The exit code is 1 if the tuned policy is refused: it is not better on that plant, or worse on the
    actuators that the policy knew.
    """
    try:
        reason = closing.close_the_loop(plant, policy, checkpoint, teacher, minutes, out)
    except subprocess.CalledProcessError as error:
        raise typer.Exit(error.returncode) from None
    if reason:
        print(f"refused: {out}/tuned/policy.onnx: {reason}")
        raise typer.Exit(1)


@app.command("estimator")
def train_estimator(
    policy: PolicyCheckpoint = STUDENT,
    out: Out = Path("out/training/estimator"),
    source: Recipe = None,
    minutes: Minutes = None,
) -> None:
    """Train the linear-velocity estimator on the policy's walks; writes DIR/estimator.onnx."""
    stages.train_estimator(_configured(estimator.EstimatorConfig, source, minutes), source, policy, out)
    _written(out / stages.ESTIMATOR_FILE)


@app.command("kalman")
def tune_kalman(policy: PolicyCheckpoint = STUDENT, source: Recipe = None) -> None:
    """Tune the Kalman filter's noise on the same kind of walks; prints the fields of `KalmanConfig`."""
    config = recipe.read_recipe(kalman_tuning.TuningConfig, source)
    recording = kalman_tuning.record(config, dagger.load_policy(policy))
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
    """Train the network that finds legs in laser scans, on real and simulated scans; writes DIR/legs.onnx in minutes."""
    config = recipe.read_recipe(leg_classifier.LegConfig, source)
    run_folder.write_run_file(out, "legs", source, config)
    real, made = leg_classifier.read_examples(config, scans)
    network = leg_classifier.train(config, list(real.values()), made)
    about = {"files": [file.name for file in real], "configuration": attrs.asdict(config)}
    leg_classifier.export(network, out / "legs.onnx", about)
    _written(out / "legs.onnx")


@app.command("legs-left-out")
def cross_validate_legs(scans: Scans, source: Recipe = None) -> None:
    """Cross-validate that network: evaluate each file of scans with a network trained on the others."""
    config = recipe.read_recipe(leg_classifier.LegConfig, source)
    for name, figures in leg_classifier.cross_validate(config, *leg_classifier.read_examples(config, scans)):
        print(
            f"{name}: " + ", ".join(f"{figure} {value:.3g}" for figure, value in figures.items()), flush=True
        )


@app.command("limit")
def limit(
    policy: Annotated[Path, typer.Argument(help="Policy file; its metadata is rewritten.", dir_okay=False)],
    forward: Annotated[float | None, typer.Option(help="Fastest forward, m/s.", min=0.0)] = None,
    backward: Annotated[float | None, typer.Option(help="Fastest backward, m/s.", min=0.0)] = None,
    sideways: Annotated[float | None, typer.Option(help="Fastest to either side, m/s.", min=0.0)] = None,
    turn: Annotated[float | None, typer.Option(help="Fastest turn either way, rad/s.", min=0.0)] = None,
    curve: Annotated[
        float | None, typer.Option(help="Largest lateral acceleration in curves, m/s^2.", min=0.1)
    ] = None,
    robot: Annotated[str, typer.Option(help="Robot of the policy: a name, or its folder.")] = DEFAULT_ROBOT,
) -> None:
    """Narrow the commands that a policy file accepts; limits that are not given stay. Write its card again afterwards.

    `quadvel paper --only sustained` shows the share of the drives' speed that each command needs.
    """
    chosen = load_robot(robot)
    known = PolicyFile(chosen, policy).metadata.limits
    low, high = list(known.low), list(known.high)
    for axis, back, ahead in ((0, backward, forward), (1, sideways, sideways), (2, turn, turn)):
        low[axis] = low[axis] if back is None else -back
        high[axis] = high[axis] if ahead is None else ahead
    limiting.limit_commands(
        chosen,
        policy,
        VelocityCommandLimits((low[0], low[1], low[2]), (high[0], high[1], high[2]), curve or known.curve),
    )
    _written(policy)


@app.command("card")
def write_card(
    network: Annotated[Path, typer.Argument(help="Policy or estimator file.")],
    evaluations: Annotated[
        list[Path], typer.Argument(help="eval.json of `quadvel eval`, or the folder it is in; one or more.")
    ],
    paper: Annotated[
        Path | None,
        typer.Option(
            help="Folder of `quadvel paper`, for gait, sustained velocities and slopes.", file_okay=False
        ),
    ] = None,
) -> None:
    """Write the model card of a network next to it: FILE.md of FILE.onnx."""
    path = network.with_suffix(".md")
    path.write_text(card(network, evaluations, paper))
    _written(path)


def main() -> None:
    """Run the program; errors in files are printed in one sentence.

    Raises:
        SystemExit: an argument, a recipe, a checkpoint or another file is wrong or missing; exit code 2.
    """
    torch.set_num_threads(env.available_cores())
    with exit_with_sentence("quadvel_training"):
        app()


if __name__ == "__main__":
    main()
