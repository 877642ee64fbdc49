"""The command `quadvel identify`, also `ros2 run quadvel_sysid identify`: logs in, report out.

It only parses options and prints; `identify` is the function behind it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import attrs
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from threadpoolctl import threadpool_limits
from typer.core import TyperCommand
from typing_extensions import override

from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description.robot import is_robot, load_robot
from quadvel_description.robot_name import shipped_robots
from quadvel_recordings.output import output_folder

from .logs.check_log import CheckedLog, check_logs
from .logs.log import Log
from .logs.read_log import read_log
from .logs.readers.columns import ColumnMap
from .logs.readers.recordings import Topics
from .memory import return_freed_arrays_to_system, reuse_freed_arrays
from .options import IdentifyOptions
from .statistics.baselines import FILTER_SPAN_S

if TYPE_CHECKING:
    from .data.dataset import Dataset
    from .report.identification import Identification

MULTI_VALUE_OPTIONS = ("--holdout", "--joints")
"""Options that take several values after one name."""
DEFAULT_CORES = 2
"""Worker processes unless `--cores` asks for more; each one takes about 200 MB."""
WITHHELD_EXIT_CODE = 3
"""Exit code if the decision is withdrawn; actuator.yaml is then written with --force alone."""
_LONG_LOG_VALUES = 1_000_000
"""Number of values of q (samples times joints) from which logs count as long: freed memory goes
back to the system, and one worker is the default.
"""
STYLE = {"note": "dim", "warning": "yellow", "refusal": "red"}
"""Style of each kind of finding in the terminal."""


class _SeveralValues(TyperCommand):
    """A command whose `MULTI_VALUE_OPTIONS` take all values up to the next option."""

    @override
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, list(_repeat_options(args)))
        except typer.BadParameter as error:
            greedy = [option for option in MULTI_VALUE_OPTIONS if option in args]
            if greedy and error.param is not None and error.param.name == "logs":
                error.message = f"Name them before {greedy[0]}, which takes all values that follow it."
            raise


def _repeat_options(arguments: Iterable[str]) -> Iterable[str]:
    """Rewrite `--holdout a b` as click parses it: `--holdout a --holdout b`."""
    option = ""
    for argument in arguments:
        if argument.startswith("--"):
            option = argument if argument in MULTI_VALUE_OPTIONS else ""
            if not option:
                yield argument
        elif option:
            yield from (option, argument)
        else:
            yield argument


app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@app.command(cls=_SeveralValues, no_args_is_help=True)
def identify(
    logs: Annotated[
        list[Path],
        typer.Argument(
            help="Logs to fit: recordings, tables, arrays; docs/identification.md lists the formats.",
        ),
    ],
    out: Annotated[
        Path, typer.Option(metavar="<folder>", help="Folder for report.html, report.json and actuator.yaml.")
    ] = Path("out/identify"),
    holdout: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="<log...>",
            help="Logs that are held out for evaluation.",
            show_default="a fifth of each log, in blocks",
        ),
    ] = None,
    base: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="actuator.yaml of the model to correct.", show_default="the shipped one"
        ),
    ] = None,
    gains: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="<kp kd>",
            help="Commanded gains, N m/rad and N m s/rad, of logs that hold none.",
            show_default="fitted",
        ),
    ] = None,
    joints: Annotated[
        list[str] | None, typer.Option(metavar="<name...>", help="Use these joints only.", show_default="all")
    ] = None,
    columns: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>",
            help="YAML file that maps the names of the logs to fields.",
            show_default="names as in docs/identification.md",
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="<name|file>",
            help="The robot, aliengo, go2 or its folder: limits of actuator.yaml, legs that replay the commands before and "
            "after. An MJCF or URDF file: replay alone.",
            show_default="that of the recording or of --base, without replay",
        ),
    ] = None,
    state_topic: Annotated[
        str | None,
        typer.Option(metavar="<topic>", help="States in recordings.", show_default="found by type"),
    ] = None,
    command_topic: Annotated[
        str | None,
        typer.Option(
            metavar="<topic>", help="Commands in recordings.", show_default="found by type and name"
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Write actuator.yaml even if the result is not plausible.")
    ] = False,
    cores: Annotated[
        int | None,
        typer.Option(
            min=1, help="Worker processes.", show_default=f"min({DEFAULT_CORES}, cores), 1 for long logs"
        ),
    ] = None,
) -> None:
    """Find what the actuator model lacks, from measured logs of joints.

    It checks the logs and prints what it found. Then it fits delays and gains of the plain model, searches for
    effects that explain the remaining torque on data that was not fitted, and writes the error before and after.

    \b
    For example, a recording of the stack while it walks, of which blocks are held out for evaluation:
      quadvel record low_state low_cmd --out walk.mcap --seconds 30
      quadvel identify walk.mcap --out out/identify
    Two logs of another robot; fit one, evaluate on the other, and replay the commands on its legs:
      quadvel identify walk_1.npz --holdout walk_2.npz --gains 35 0.5 --robot go2 --out out/identify
    Some of its joints:
      quadvel identify walk_1.npz --joints FR_hip FR_thigh FR_calf --out out/identify

    \b
    An NPZ file holds, in SI units, N samples of J joints:
      t (N,)   q, dq (N, J)   q_des (N, J), or t_cmd (M,) with q_des_cmd (M, J)
      and if known: tau, kp, kd, dq_des, tau_ff, temperature, voltage, joint_names, valid
    A CSV file has the same fields as columns: t, q/FR_hip_joint, dq/FR_hip_joint, ...
    Other names, units and signs, in a map file: t: {from: timestamp, scale: 1.0e-6}

    Other files in the folder are kept. Ctrl-C leaves the folder unchanged. Exit code 3: the result is not that of
    a PD-controlled joint, or another model predicts better; actuator.yaml is then not written without --force.
    """
    messages = Console(markup=False, stderr=True)
    try:
        output_folder(out)
        named = [path.resolve() for path in (*logs, *(holdout or []))]
        if twice := [path for path in named if named.count(path) > 1]:
            raise ValueError(f"{twice[0]}: named twice, expected each log once, for the fit or held out")
        return_freed_arrays_to_system()
        names = ColumnMap() if columns is None else ColumnMap.load(columns)
        kind = _robot_of_logs(robot)
        parameters = None
        if base is not None:
            parameters = ActuatorParameters.load(load_robot(kind) if kind else None, base, some_joints=True)
            kind = kind or parameters.robot
        topics = Topics(state_topic, command_topic)
        read = partial(read_log, joints=joints, names=names, topics=topics, robot=kind)
        options = IdentifyOptions(gains=gains, base=parameters, robot=robot)
        found = _identify(logs, holdout or [], read, options, cores, messages)
        _write(found, out, force, messages)
        if found.report["withheld"]:
            raise typer.Exit(WITHHELD_EXIT_CODE)
    except KeyboardInterrupt:
        raise typer.Exit(130) from None


def _robot_of_logs(robot: str | None) -> str | None:
    """Check `--robot` before logs are read; return it if the logs may be of that robot, None for a mere body.

    Raises:
        FileNotFoundError: There is no such robot or file.
        ValueError: The file of the robot is malformed.
    """
    if robot is None:
        return None
    if is_robot(robot):
        load_robot(robot)
        return robot
    if not Path(robot).is_file():
        expected = f"{', '.join(shipped_robots())}, the folder of a robot, an MJCF or a URDF file"
        raise FileNotFoundError(f"--robot: found {robot!r}, expected {expected}")
    return None


def _identify(
    train_paths: Sequence[Path],
    heldout_paths: Sequence[Path],
    read: Callable[[Path], Log],
    options: IdentifyOptions,
    cores: int | None,
    messages: Console,
) -> Identification:
    """Read the logs and identify the model; findings and progress go to `messages`."""
    parts = (BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with (
        Progress(*parts, console=messages, transient=True, disable=not messages.is_terminal) as bar,
        threadpool_limits(1),
    ):
        task = bar.add_task("reading", total=1.0)

        def on_progress(share: float, text: str) -> None:
            bar.update(task, completed=share, description=text)

        def prepare() -> tuple[Dataset, bool]:
            """Read and check the logs; release long ones, and return whether they are long."""
            train, heldout = ([read(path) for path in paths] for paths in (train_paths, heldout_paths))
            checked = check_logs(train, heldout, options.gains, lambda one: print_findings(one, messages))
            long = sum(one.log.q.size for part in checked for one in part) >= _LONG_LOG_VALUES
            # Imported here, so that errors in the files appear before the engine is loaded.
            from .data.dataset import Dataset

            return Dataset.prepare(*checked, options.max_values, on_progress), long

        dataset, long = prepare()
        if not long:
            reuse_freed_arrays()
        from .identify import identify_dataset

        cores = cores or (1 if long else min(DEFAULT_CORES, len(os.sched_getaffinity(0))))
        return identify_dataset(dataset, attrs.evolve(options, cores=cores), on_progress)


def _write(found: Identification, out: Path, force: bool, messages: Console) -> None:
    """Write the report and print a summary."""
    from .report.report import write_report
    from .report.summary_text import leave_one_out_text

    names = write_report(found, out, force)
    console = Console(markup=False)
    console.print(str(found.report["decision"]), soft_wrap=True, highlight=False)
    console.print(error_line(found.report), soft_wrap=True, highlight=False)
    if "replay" in found.report:
        console.print(replay_line(found.report["replay"]), soft_wrap=True, highlight=False)
    if "leave_one_out" in found.report:
        console.print(leave_one_out_text(found.report["leave_one_out"]), soft_wrap=True, highlight=False)
    for text in found.report["warnings"]:
        messages.print(f"warning: {text}", style=STYLE["warning"], soft_wrap=True, highlight=False)
    console.print(f"written: {out}/{', '.join(names)}", soft_wrap=True, highlight=False)


def error_line(report: Mapping[str, Any]) -> str:
    """Format the held-out errors of all models, baselines included, in one line.

    Args:
        report: Content of report.json.

    Returns:
        The line, with the share of the torque's variance that each model explains.
    """
    entries = (
        *((("PD as commanded", report["pd"]),) if report["reference_gains"]["commanded"] else ()),
        ("a PD law of each joint", report["baselines"]["joint_pd"]),
        (f"a linear filter over {1e3 * FILTER_SPAN_S:.0f} ms", report["baselines"]["ridge"]),
        ("plain EAM", report["before"]),
        ("corrected model", report["after"]),
    )
    each = ", ".join(f"{name} {entry['heldout_mse']:.3g}{_explained_text(entry)}" for name, entry in entries)
    return f"held-out error, N^2 m^2: {each} (noise {report['noise_floor']:.3g})"


def _explained_text(entry: Mapping[str, Any]) -> str:
    """Share of the torque's variance that a model explains, in parentheses, or nothing."""
    found = entry.get("heldout_explained")
    return "" if found is None else f" (explains {100.0 * found:.3g} % of the variance)"


def replay_line(replay: Mapping[str, Any]) -> str:
    """Format the deviations of the replayed legs from their measured motion in one line.

    Args:
        replay: The entry `replay` of report.json.

    Returns:
        The line.
    """
    before, after = replay["before"], replay["after"]
    return (
        f"replayed over {1e3 * replay['stretch_s']:.0f} ms, root mean square: angles off by {before['q_rms_rad']:.3g} rad "
        f"before, {after['q_rms_rad']:.3g} after; speeds by {before['dq_rms_rad_s']:.3g} and {after['dq_rms_rad_s']:.3g} rad/s"
    )


def print_findings(checked: CheckedLog, messages: Console) -> None:
    """Print the findings about a log.

    Args:
        checked: The log with its findings.
        messages: Console to print to.
    """
    messages.print(checked.log.name, style="bold", soft_wrap=True, highlight=False)
    for finding in checked.findings:
        line = f"  {finding.kind:8} {finding.text}"
        messages.print(line, style=STYLE[finding.kind], soft_wrap=True, highlight=False)


def main() -> None:
    """Run the command; a wrong argument or file ends it with one sentence and exit code 2."""
    try:
        app()
    except (OSError, ValueError) as error:
        print(f"identify: {error}", file=sys.stderr)
        sys.exit(2)
