"""The command `quadvel policy import`: a policy of another project becomes one ONNX file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import load_robot
from quadvel_policy.imported.importer import Supplement, import_policy
from quadvel_policy.imported.metadata import ImportedMetadata
from quadvel_recordings.output import atomic_write, output_file


def import_command(
    weights: Annotated[Path, typer.Argument(help="ONNX file of the other project.", show_default=False)],
    out: Annotated[Path, typer.Option(metavar="<file>", help="ONNX file to write.")] = Path(
        "out/policy.onnx"
    ),
    robot: Annotated[str, typer.Option(metavar="<name|file>", help="The robot of the policy.")] = "go2",
    config: Annotated[
        Path | None,
        typer.Option(
            "--with",
            metavar="<file>",
            help="unitree_rl_lab's deploy.yaml, or rl_sar's config.yaml, with base.yaml in its folder or the one above.",
            show_default="mjlab's metadata in the ONNX file",
        ),
    ] = None,
    limits: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="<vx vy wz>",
            help="Largest commands of the training, m/s and rad/s, if the format has none.",
            show_default="those of the format",
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            metavar="<hz>",
            help="Rate of the policy, Hz, if the format has none.",
            show_default="that of the format",
        ),
    ] = None,
) -> None:
    """Import a policy of unitree_rl_lab, rl_sar or mjlab into one ONNX file.

    A field that is missing or does not fit ends the command with an error that names it.

    \b
    For example:
      quadvel policy import policy.onnx --with deploy.yaml --out go2.onnx
      quadvel eval --grid quick --robot go2 --policy go2.onnx --estimator kalman
    """
    output_file(out)
    for given in (weights, *([config] if config else [])):
        if out.resolve() == given.resolve():
            raise ValueError(f"--out: found {out}, a file that is read, expected another one")
    supplement = Supplement(limits=limits, rate_hz=rate)
    metadata, content = import_policy(load_robot(robot), weights, config, supplement)
    with atomic_write(out) as draft:
        draft.write_bytes(content)
    terms = ", ".join(f"{term.name} x {len(term.ages)}" for term in metadata.terms)
    print(f"{metadata.source}: {metadata.size} numbers at {metadata.rate_hz:g} Hz: {terms}")
    for line in _joint_table(metadata):
        print(line)
    for axis, (low, high) in metadata.command_limits.items():
        print(f"command {axis}: {low:g} to {high:g} {'rad/s' if axis == 'wz' else 'm/s'}")
    if any(term.name == "linear_velocity" for term in metadata.terms):
        print(
            "it observes the linear velocity: run it with --estimator kalman, as the learned estimator knows the "
            "gait of the shipped policy only"
        )
    print(f"written: {out}")


def _joint_table(metadata: ImportedMetadata) -> Iterator[str]:
    """Yield a line for each output of the network: joint, posture, target = offset + scale x action, gains."""
    yield "action  joint            posture, rad   target, rad           kp, N m/rad  kd, N m s/rad"
    for number, joint in enumerate(metadata.joint_map):
        target = f"{metadata.action_offset[joint]:+.3f} {metadata.action_scale[joint]:+.3f} a"
        yield (
            f"{number:6}  {JOINT_NAMES[joint]:15}  {metadata.nominal_q[joint]:+12.3f}   {target:20}  "
            f"{metadata.kp[joint]:11g}  {metadata.kd[joint]:13g}"
        )
