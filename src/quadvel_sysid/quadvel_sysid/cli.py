"""The command `quadvel identify`, which `ros2 run quadvel_sysid identify` is too: files in, report out."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from threadpoolctl import threadpool_limits
from typer.core import TyperCommand

from quadvel_actuator.parameters import ActuatorParameters

from .baselines import SPAN
from .logs.checks import Inspection
from .logs.columns import ColumnMap
from .logs.dataset import Dataset
from .logs.read_log import read_log
from .logs.recordings import Topics
from .memory import give_large_arrays_back, keep_freed_arrays

if TYPE_CHECKING:
    from .identification_data import IdentificationData
    from .identification_data import Progress as Tell

SEVERAL = ("--holdout", "--joints")
CORES = 2
"""Unless more are asked for: each takes some 200 MB"""
_LONG = 1_000_000
"""Values of q in all logs, from which memory counts for more than time: ten minutes of twelve joints take less than 1 GB"""
STYLE = {"note": "dim", "warning": "yellow", "refusal": "red"}


class _SeveralValues(TyperCommand):
    """An option in SEVERAL takes all values up to the next option: a log named after --holdout is never fitted."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, list(_repeated(args)))


def _repeated(arguments: Iterable[str]) -> Iterable[str]:
    """`--holdout a b` as click reads it: `--holdout a --holdout b`."""
    option = ""
    for argument in arguments:
        if argument.startswith("--"):
            option = argument if argument in SEVERAL else ""
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
            metavar="<log...>", help="Logs to judge on.", show_default="a fifth of each log, in blocks"
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
            help="YAML file that says what the logs call the fields.",
            show_default="names as in docs/identification.md",
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="<name|file>",
            help="Replay the commands on this robot's legs before and after: aliengo, go2, or an MJCF or URDF file.",
            show_default="no replay",
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
    cores: Annotated[
        int | None,
        typer.Option(
            min=1, help="How many share the work.", show_default=f"those there are, {CORES} at most"
        ),
    ] = None,
) -> None:
    """Find what the actuator model lacks, from measured logs of joints.

    First it says what it sees in the data. Then it fits delays and gains of the plain model, looks for what is
    left of the measured torque, adds the effects that explain it on data which was not fitted, and writes
    the error before and after.

    \b
    For example, a recording of the stack while it walks, of which blocks are kept aside to judge on:
      quadvel record low_state low_cmd --out walk.mcap --seconds 30
      quadvel identify walk.mcap --out out/identify
    Two logs of another robot; fit one, judge on the other, and replay the commands on its legs:
      quadvel identify walk_1.npz --holdout walk_2.npz --gains 35 0.5 --robot go2 --out out/identify
    Some joints of it:
      quadvel identify walk_1.npz --joints FR_hip FR_thigh FR_calf --out out/identify

    \b
    An NPZ file holds, in SI units, N samples of J joints:
      t (N,)   q, dq (N, J)   q_des (N, J), or t_cmd (M,) with q_des_cmd (M, J)
      and if known: tau, kp, kd, dq_des, tau_ff, temperature, voltage, joint_names, valid
    A CSV file has the same as columns: t, q/FR_hip_joint, dq/FR_hip_joint, ...
    Other names, units and signs, in a map file: t: {from: timestamp, scale: 1.0e-6}

    What is in the folder besides the three files stays. Ctrl-C leaves the folder as it was.
    """
    messages = Console(stderr=True)
    topics = Topics(state_topic, command_topic)
    try:
        _run(logs, holdout or [], out, base, gains, joints, columns, topics, robot, cores, messages)
    except KeyboardInterrupt:
        messages.print("stopped; nothing was written")
        raise typer.Exit(130) from None


def _run(
    logs: Sequence[Path],
    holdout: Sequence[Path],
    out: Path,
    base: Path | None,
    gains: tuple[float, float] | None,
    joints: Sequence[str] | None,
    columns: Path | None,
    topics: Topics,
    robot: str | None,
    cores: int | None,
    messages: Console,
) -> None:
    _check_folder(out)
    names = ColumnMap() if columns is None else ColumnMap.load(columns)
    give_large_arrays_back()
    parameters = ActuatorParameters.default() if base is None else ActuatorParameters.load(base)
    parts = (BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*parts, console=messages, transient=True) as bar:
        task = bar.add_task("reading", total=1.0)

        def tell(share: float, text: str) -> None:
            bar.update(task, completed=share, description=text)

        material, long = _material(logs, holdout, joints, names, topics, gains, messages, tell)
        if not long:
            keep_freed_arrays()
        from .identify import identify_prepared

        cores = cores or (1 if long else min(CORES, len(os.sched_getaffinity(0))))
        with threadpool_limits(1):  # of each copy of this process: they share the cores
            found = identify_prepared(material, parameters, cores, tell, robot)
    from .report.report import write_report

    write_report(found, out)
    console = Console()
    console.print(escape(str(found.report["decision"])), soft_wrap=True, highlight=False)
    console.print(errors(found.report), soft_wrap=True, highlight=False)
    if "replay" in found.report:
        console.print(replays(found.report["replay"]), soft_wrap=True, highlight=False)
    for text in found.report["warnings"]:
        messages.print(escape(f"warning: {text}"), style=STYLE["warning"], soft_wrap=True, highlight=False)
    console.print(f"written: {out}/report.html, report.json, actuator.yaml", soft_wrap=True, highlight=False)


def _material(
    logs: Sequence[Path],
    holdout: Sequence[Path],
    joints: Sequence[str] | None,
    names: ColumnMap,
    topics: Topics,
    gains: tuple[float, float] | None,
    messages: Console,
    tell: Tell,
) -> tuple[IdentificationData, bool]:
    """What of the files is computed on, and whether they hold long logs, which are let go of here."""
    with threadpool_limits(1):
        fitted, heldout = (
            [read_log(one, joints, names, topics) for one in paths] for paths in (logs, holdout)
        )
        data = Dataset.of(fitted, heldout, gains, lambda one: say(one, messages))
        long = sum(log.q.size for log in data.logs) >= _LONG
        from .identification_data import (
            prepare,
        )  # what is wrong with the files shows before the engine is loaded

        return prepare(data, progress=tell), long


def errors(report: Mapping[str, Any]) -> str:
    """The held-out errors in a line with the shares that they explain, those of what needs no model among them."""
    entries = (
        ("PD as commanded", report["pd"]),
        ("a PD law of each joint", report["baselines"]["joint_pd"]),
        (f"a linear filter over {1e3 * SPAN:.0f} ms", report["baselines"]["ridge"]),
        ("plain EAM", report["before"]),
        ("corrected model", report["after"]),
    )
    each = ", ".join(f"{name} {entry['heldout_mse']:.3g}{_share(entry)}" for name, entry in entries)
    return f"held-out error, N^2 m^2: {each} (noise {report['noise_floor']:.3g})"


def _share(entry: Mapping[str, Any]) -> str:
    """How much of the torque's variance an account explains; nothing where the torque does not vary."""
    found = entry.get("heldout_explained")
    return "" if found is None else f" (explains {100.0 * found:.3g} % of the variance)"


def replays(replay: Mapping[str, Any]) -> str:
    """How far the legs leave their measured track, in a line."""
    before, after = replay["before"], replay["after"]
    return (
        f"replayed over {1e3 * replay['stretch_s']:.0f} ms, root mean square: angles off by {before['q_rms_rad']:.3g} rad "
        f"before, {after['q_rms_rad']:.3g} after; speeds by {before['dq_rms_rad_s']:.3g} and {after['dq_rms_rad_s']:.3g} rad/s"
    )


def say(inspection: Inspection, messages: Console) -> None:
    """Print what was found in a log."""
    messages.print(escape(inspection.log.name), style="bold", soft_wrap=True, highlight=False)
    for finding in inspection.findings:
        line = f"  {finding.kind:8} {finding.text}"
        messages.print(escape(line), style=STYLE[finding.kind], soft_wrap=True, highlight=False)


def _check_folder(out: Path) -> None:
    """Raises OSError where `out` cannot become a folder to write to, which is tried; nothing is left of that."""
    there = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    if not there.is_dir():
        raise NotADirectoryError(f"{out}: is a file or lies below one, expected a folder")
    try:
        TemporaryFile(dir=there).close()
    except OSError as error:
        raise type(error)(f"{out}: the folder can't be written to: {error.strerror}") from None


def main() -> None:
    """A wrong argument or file ends in one sentence and exit code 2, without a traceback."""
    try:
        app()
    except (OSError, ValueError) as error:
        print(f"identify: {error}", file=sys.stderr)
        sys.exit(2)
