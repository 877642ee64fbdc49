"""The command `quadvel policy import`: a policy of another project becomes one ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadvel_description.robot import load_robot
from quadvel_policy.imported.importer import Supplement, import_policy
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
    print(f"written: {out}")
