"""Score of the identification on logs of others: measured walks, and logs with one fault each.

    python -m benchmarks.identification.others walks FOLDER
    python -m benchmarks.identification.others faulty FILE --seeds 51,52,53 --kinds clean,kd_zero

FOLDER holds `go2_walk_1.npz` and `go2_walk_2.npz`. FILE is a Python file with `plant(seed, wrap)`,
which returns the arrays of a log, and `FAULTS`: a function for each fault, which changes them.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from quadvel_sysid.identify import identify
from quadvel_sysid.logs.log import LogError
from quadvel_sysid.logs.read_log import read_log
from quadvel_sysid.options import IdentifyOptions

WALKS = ("go2_walk_1.npz", "go2_walk_2.npz")
WALK_GAINS = (35.0, 0.5)
"""kp (N m/rad) and kd (N m s/rad) of the recording lab's driver; the walks hold none."""
FRICTION, DAMPING, DELAY_MS = 0.6, 0.8, 5.0
"""Truth of the faulty logs: N m, N m s/rad, ms."""

Report = dict[str, Any]
app = typer.Typer(add_completion=False)


@app.command()
def walks(
    folder: Path, robot: Annotated[str, typer.Option(help="Legs of the replay, such as go2.")] = ""
) -> None:
    """Fit each measured walk and judge the model on the other one."""
    options = IdentifyOptions(gains=WALK_GAINS, robot=robot or None)
    print(
        "| fitted, judged | PD | joint PD | ridge | plain EAM | corrected | ratio | noise | rows | clock, ms | s | model |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for fitted, judged in (WALKS, WALKS[::-1]):
        start = time.process_time()
        report = identify([read_log(folder / fitted)], [read_log(folder / judged)], options).report
        seconds = time.process_time() - start
        errors = [
            report["pd"],
            report["baselines"]["joint_pd"],
            report["baselines"]["ridge"],
            report["before"],
            report["after"],
        ]
        cells = [f"{one['heldout_mse']:.3g}" for one in errors]
        ratio = report["after"]["heldout_mse"] / report["before"]["heldout_mse"]
        clocks = [f"{one['command_offset_ms']:.2f}{' even' * one['even']}" for one in report["clocks"]]
        cells += [
            f"{ratio:.2f}",
            f"{report['noise_floor']:.2g}",
            str(report["judged_rows"]),
            ", ".join(clocks),
        ]
        cells += [f"{seconds:.0f}", ", ".join(one["name"] for one in report["effects"])]
        print(f"| {fitted}, {judged} | {' | '.join(cells)} |", flush=True)
        for text in (report["decision"], *report["warnings"]):
            Console(markup=False, stderr=True).print(text, highlight=False)


@app.command()
def faulty(
    file: Path,
    seeds: Annotated[
        str, typer.Option(help="Seeds of the plant, separated by commas.")
    ] = "51,52,53,54,55,56",
    kinds: Annotated[str, typer.Option(help="Faults, separated by commas (default: all).")] = "",
) -> None:
    """Identify logs with one fault each, and compare with what is asked of each fault."""
    spec = importlib.util.spec_from_file_location("faulty_logs", file)
    if spec is None or spec.loader is None:
        raise typer.BadParameter(f"{file}: expected a Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for kind in kinds.split(",") if kinds else list(module.FAULTS):
        right = []
        for seed in map(int, seeds.split(",")):
            log = module.plant(seed=seed, wrap=kind == "wrapped")
            if module.FAULTS[kind][0]:
                module.FAULTS[kind][0](log)
            verdict, text = _verdict(kind, log)
            right.append(verdict)
            print(f"{kind} {seed}: {'right' if verdict else 'WRONG'}: {text}", flush=True)
        print(f"{kind}: {sum(right)} of {len(right)} as asked", flush=True)


def _verdict(kind: str, log: dict[str, Any]) -> tuple[bool, str]:
    """Whether the outcome for a faulty log is the one asked for, and the outcome."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{kind}.npz"
        np.savez(path, **log)
        try:
            report = dict(identify([read_log(path)]).report)
        except LogError as error:
            return kind in REFUSED, f"refused: {str(error)[:160]}"
    if report["withheld"]:
        return kind in REFUSED, report["decision"][:200]
    names = [one["name"] for one in report["effects"]]
    found = next((one for one in report["effects"] if one["name"] == "coulomb_friction"), None)
    friction = np.mean(found["params"]["c"]["value"]) if found else np.nan
    interval = report["after"]["input_delay_ms_ci95"]
    text = f"{', '.join(names)}; friction {friction:.3f}; delay {np.round(interval, 2).tolist()} ms; {report['decision'][:120]}"
    asked = ACCEPTED.get(kind)
    return asked is not None and asked(report, names, friction), text


def _friction_within(
    share: float, alone: bool, delay: bool = False
) -> Callable[[Report, Sequence[str], float], bool]:
    """Accept reports whose friction is right, perhaps as the only effect, perhaps with the delay."""

    def accepts(report: Report, names: Sequence[str], friction: float) -> bool:
        low, high = np.ravel(report["after"]["input_delay_ms_ci95"])[:2]
        near = abs(friction / FRICTION - 1.0) <= share
        return near and (not alone or len(names) == 1) and (not delay or low <= DELAY_MS <= high)

    return accepts


def _damping_found(report: Report, names: Sequence[str], friction: float) -> bool:
    """Accept reports with the drive's own damping, although none was commanded."""
    damping = float(np.mean(report["after"]["delta_kd"]))
    return abs(damping / DAMPING - 1.0) <= 0.05 and _friction_within(0.05, True)(report, names, friction)


CLEAN = _friction_within(0.05, alone=True, delay=True)
ACCEPTED = {
    "clean": CLEAN,
    "gap_with_lost_rows": CLEAN,
    "wrapped": CLEAN,
    "state_held": _friction_within(0.15, alone=False),
    "kd_zero": _damping_found,
    "speed_from_ticks": _friction_within(0.15, alone=True),
    "no_speed": _friction_within(0.10, alone=False),
    "speed_magnitude": _friction_within(0.15, alone=False),
}
"""Which reports are right, for the faults that need not be refused."""
REFUSED = {"late_command", "state_held", "torque_magnitude", "speed_magnitude", "wrapped", "one_sign"}
"""Faults for which a refusal, or a withheld model, is right."""


if __name__ == "__main__":
    app()
