"""Closed loop on a plant that training never saw, as a sequence of commands.

A walk is recorded, the model corrected from it, the policy tuned on that model, and both policies
compared on the same plants.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

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
) -> Path:
    """Run the steps whose files are missing; each command is printed before it runs.

    Args:
        plant: plant of the gap.
        policy: policy file that was written from `checkpoint`.
        checkpoint: checkpoint of `dagger`.
        teacher: checkpoint of `privileged`, its teacher.
        minutes: time for which the policy is tuned, minutes.
        out: folder of the results.

    Returns:
        The page with the errors of both policies.

    Raises:
        subprocess.CalledProcessError: a command failed.
    """
    out.mkdir(parents=True, exist_ok=True)
    for file, arguments in (all_of_them := fill_steps(plant, policy, checkpoint, teacher, minutes, out)):
        if file.exists():
            print(f"kept: {file}", flush=True)
        else:
            print("$ python", shlex.join(arguments), flush=True)
            subprocess.run([sys.executable, *arguments], check=True)
    return all_of_them[-1][0]
