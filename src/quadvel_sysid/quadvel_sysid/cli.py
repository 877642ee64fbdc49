"""The command `quadvel identify`, which `ros2 run quadvel_sysid identify` is too: files in, report out."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Any

import attrs
import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from threadpoolctl import threadpool_limits
from typer.core import TyperCommand

from quadvel_actuator.parameters import ActuatorParameters

from .logs.inspect import Inspection, inspect
from .logs.log import Log, LogError
from .logs.read_log import read_log
from .memory import give_large_arrays_back, keep_freed_arrays

if TYPE_CHECKING:
    from .material import Material
    from .material import Progress as Tell

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
        list[Path], typer.Argument(metavar="LOG...", help="Logs to fit: .mcap, rosbag2 folder, .npz or .csv.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for report.html, report.json and actuator.yaml.")],
    holdout: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="LOG...", help="Logs to judge on.", show_default="a third of each LOG, in blocks"
        ),
    ] = None,
    base: Annotated[
        Path | None,
        typer.Option(help="actuator.yaml of the model to correct.", show_default="the shipped one"),
    ] = None,
    gains: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="KP KD",
            help="Commanded gains, N m/rad and N m s/rad, of logs that hold none.",
            show_default="fitted",
        ),
    ] = None,
    joints: Annotated[
        list[str] | None, typer.Option(metavar="NAME...", help="Use these joints only.", show_default="all")
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
    Two logs of another robot; fit one, judge on the other:
      quadvel identify walk_1.npz --holdout walk_2.npz --gains 35 0.5 --out out/identify
    Some joints of it:
      quadvel identify walk_1.npz --joints FR_hip FR_thigh FR_calf --out out/identify

    \b
    An NPZ file holds, in SI units, N samples of J joints:
      t (N,)   q, dq (N, J)   q_des (N, J), or t_cmd (M,) with q_des_cmd (M, J)
      and if known: tau, kp, kd, dq_des, tau_ff, temperature, voltage, joint_names, valid
    A CSV file has the same as columns: t, q/FR_hip_joint, dq/FR_hip_joint, ...

    What is in the folder besides the three files stays. Ctrl-C leaves the folder as it was.
    """
    messages = Console(stderr=True)
    try:
        _run(logs, holdout or [], out, base, gains, joints, cores, messages)
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
    cores: int | None,
    messages: Console,
) -> None:
    _check_folder(out)
    give_large_arrays_back()
    parameters = ActuatorParameters.default() if base is None else ActuatorParameters.load(base)
    columns = (BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=messages, transient=True) as bar:
        task = bar.add_task("reading", total=1.0)

        def tell(share: float, text: str) -> None:
            bar.update(task, completed=share, description=text)

        material, long = _material(logs, holdout, joints, gains, messages, tell)
        if not long:
            keep_freed_arrays()
        from .identify import identified

        cores = cores or (1 if long else min(CORES, len(os.sched_getaffinity(0))))
        with threadpool_limits(1):  # of each copy of this process: they share the cores
            found = identified(material, parameters, cores, tell)
    from .report.report import write

    write(found, out)
    console = Console()
    console.print(escape(str(found.report["decision"])), soft_wrap=True, highlight=False)
    console.print(f"written: {out}/report.html, report.json, actuator.yaml", soft_wrap=True, highlight=False)


def _material(
    logs: Sequence[Path],
    holdout: Sequence[Path],
    joints: Sequence[str] | None,
    gains: tuple[float, float] | None,
    messages: Console,
    tell: Tell,
) -> tuple[Material, bool]:
    """What of the files is computed on, and whether they hold long logs, which are let go of here."""
    fitted = read(logs, joints, gains, messages)
    judged = read(holdout, joints, gains, messages, like=fitted[0])
    long = sum(log.q.size for log in (*fitted, *judged)) >= _LONG
    from .material import gathered  # what is wrong with the files shows before the engine is loaded

    with threadpool_limits(1):
        return gathered(fitted, judged, gains, progress=tell), long


def read(
    paths: Sequence[Path],
    joints: Sequence[str] | None,
    gains: tuple[float, float] | None,
    messages: Console,
    like: Log | None = None,
) -> list[Log]:
    """The logs as they are, their joints in the order of `like`, the first one; what is found goes to `messages`.

    Raises LogError, one sentence, where a log is refused or does not fit the others.
    """
    logs: list[Log] = []
    for path in paths:
        log = read_log(path, joints)
        like = like or log
        log = _like(log, like)
        inspection = inspect(_with_gains(log, gains))
        say(inspection, messages)
        inspection.raise_refusal()
        logs.append(log)
    return logs


def _like(log: Log, first: Log) -> Log:
    """The log with the joints of the first; it must hold torque if that one does."""
    if (log.tau is None) != (first.tau is None):
        lacking, other = (log, first) if log.tau is None else (first, log)
        raise LogError(f"{lacking.name}: tau: the field is missing, expected it as in {other.name}")
    if len(log.joints) > len(first.joints):
        extra = next(name for name in log.joints if name not in first.joints)
        raise LogError(f"{log.name}: joint_names: '{extra}' is not in {first.name}, expected the same joints")
    return log.select(first.joints)


def _with_gains(log: Log, gains: tuple[float, float] | None) -> Log:
    """The log with the given gains where it holds none. Raises ValueError."""
    if gains is None:
        return log
    if not np.isfinite(gains).all() or min(gains) < 0.0:
        raise ValueError(f"--gains: found {gains[0]:g} {gains[1]:g}, expected two gains of 0 or more")
    kp, kd = (np.broadcast_to(gain, log.q_des.shape) for gain in gains)
    return attrs.evolve(log, kp=kp if log.kp is None else log.kp, kd=kd if log.kd is None else log.kd)


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
