"""Closed loop on a plant that training never saw, as a sequence of commands.

A walk is recorded, the model corrected from it, the policy tuned on that model, and both policies
compared on the same plants. A tuned policy that is not better there, or worse on the actuators that the
policy knew, is refused.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import attrs
import numpy as np

from quadvel_eval.paper.files import read_records
from quadvel_eval.paper.gap import TRAINED, paired_errors
from quadvel_eval.paper.section import Record, select

from .env import available_cores

STEPS = (  # file that a step writes, and arguments of python
    ("{out}/walk.npz", "-m quadvel_training record --plant {plant} --policy {policy} --out {file}"),
    ("{out}/identified/actuator.yaml", "-m quadvel_bringup identify {out}/walk.npz --out {out}/identified"),
    (
        "{out}/tuned/policy.onnx",
        "-m torch.distributed.run --standalone --nproc-per-node={cores} -m -- quadvel_training tune "
        "--actuator {out}/identified/actuator.yaml --policy {checkpoint} --teacher {teacher} --minutes {minutes} --out {out}/tuned",
    ),
    (
        "{out}/gap/README.md",
        "-m quadvel_bringup paper --only gap --out {out}/gap --policy before={policy} --policy after={out}/tuned/policy.onnx",
    ),
)


@attrs.frozen
class Comparison:
    """Both policies on the same walks of one plant.

    Attributes:
        plant: plant of the gap.
        before: m/s, mean velocity error of the policy, on walks that neither fell on.
        after: m/s, the same of the tuned policy.
        uncertainty: m/s, two standard errors of the mean difference, over the commands: seeds of one
            command hardly differ.
        more_falls: falls of the tuned policy, minus those of the policy.
    """

    plant: str
    before: float
    after: float
    uncertainty: float
    more_falls: int

    @classmethod
    def of(cls, records: Sequence[Record], plant: str) -> Comparison:
        """Compare the policies `before` and `after`.

        Args:
            records: records of the section `gap`.
            plant: plant of the gap.

        Returns:
            The comparison; NaN where no command was walked by both.
        """
        mine = select(records, level=plant)
        falls = {name: sum(r["fell"] for r in select(mine, policy=name)) for name in ("before", "after")}
        commands = {tuple(r[axis] for axis in ("vx", "vy", "wz")) for r in mine}
        by_command = [paired_errors(_of_command(mine, one), "before", "after") for one in sorted(commands)]
        means = np.array([(a.mean(), b.mean()) for a, b in by_command if len(a)]).reshape(-1, 2)
        before, after = means.mean(axis=0).tolist() if len(means) else (np.nan, np.nan)
        spread = np.std(means[:, 1] - means[:, 0], ddof=1) if len(means) > 1 else np.nan
        uncertainty = 2.0 * float(spread) / max(len(means), 1) ** 0.5
        return cls(plant, before, after, uncertainty, falls["after"] - falls["before"])

    def __str__(self) -> str:
        """Return plant, errors and falls as a line."""
        falls = f", {self.more_falls:+d} falls" if self.more_falls else ""
        share = 100.0 * (self.after / self.before - 1.0)
        return (
            f"{self.plant}: mean error {self.before:.4f}, tuned {self.after:.4f} m/s "
            f"({share:+.0f} %; difference known to {self.uncertainty:.4f} m/s){falls}"
        )


def _of_command(records: Sequence[Record], command: tuple[float, ...]) -> list[Record]:
    """Select the records of a command vx, vy (m/s), wz (rad/s)."""
    return select(records, **dict(zip(("vx", "vy", "wz"), command, strict=True)))


def refusal(on_plant: Comparison, as_trained: Comparison) -> str:
    """Return why a tuned policy should not replace the one before.

    Args:
        on_plant: comparison on the plant that it was tuned for.
        as_trained: comparison on the plant of the robot's own actuator model.

    Returns:
        One sentence; "" if it is better on the plant and no worse as trained.
    """
    if on_plant.more_falls > 0 or not on_plant.after < on_plant.before - on_plant.uncertainty:
        return f"it is not better on the plant that it was tuned for ({on_plant})"
    if as_trained.more_falls > 0 or not as_trained.after <= as_trained.before + as_trained.uncertainty:
        return f"it is worse on the actuators that the policy knew ({as_trained})"
    return ""


def fill_steps(
    plant: str, policy: Path, checkpoint: Path, teacher: Path, minutes: float, out: Path
) -> list[tuple[Path, list[str]]]:
    """Fill `STEPS` in.

    Args:
        plant: plant of the gap.
        policy: policy file that was written from `checkpoint`.
        checkpoint: checkpoint of `dagger`.
        teacher: checkpoint of `privileged`, its teacher.
        minutes: time for which the policy is tuned, minutes.
        out: folder of the results.

    Returns:
        For each step, the file that it ends with and the arguments of python.
    """
    known = {"plant": plant, "policy": policy, "checkpoint": checkpoint, "teacher": teacher, "out": out}
    known |= {"minutes": minutes, "cores": available_cores()}
    filled = [(file.format(**known), command) for file, command in STEPS]
    return [
        (Path(file), [word.format(file=file, **known) for word in command.split()])
        for file, command in filled
    ]


def close_the_loop(
    plant: str, policy: Path, checkpoint: Path, teacher: Path, minutes: float, out: Path
) -> str:
    """Run the steps whose files are missing, and the comparison; each command is printed before it runs.

    At the end the errors of both policies are printed, on the plant and on that of the robot's own
    actuator model.

    Args:
        plant: plant of the gap.
        policy: policy file that was written from `checkpoint`.
        checkpoint: checkpoint of `dagger`.
        teacher: checkpoint of `privileged`, its teacher.
        minutes: time for which the policy is tuned, minutes.
        out: folder of the results.

    Returns:
        Why the tuned policy is refused, one sentence; "" if it is better.

    Raises:
        subprocess.CalledProcessError: a command failed.
    """
    out.mkdir(parents=True, exist_ok=True)
    steps = fill_steps(plant, policy, checkpoint, teacher, minutes, out)
    page, _ = steps[-1]
    for file, arguments in steps:
        if file.exists() and file != page:  # `paper` itself keeps what is up to date
            print(f"kept: {file}", flush=True)
        else:
            print("$ python", shlex.join(arguments), flush=True)
            subprocess.run([sys.executable, *arguments], check=True)
    records = read_records(page.with_name("gap.csv"))
    compared = [Comparison.of(records, name) for name in (plant, TRAINED)]
    print(*compared, f"written: {out}", sep="\n")
    return refusal(*compared)
