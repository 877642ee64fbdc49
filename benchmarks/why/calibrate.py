"""Writes the limits of `quadvel why`: the largest number that each cause measures on healthy walks.

    python -m benchmarks.why.calibrate --walks 24 --out out/why_limits

The walks have the seeds 900, 901, ...; as in the blind suite, which has other seeds, every second plant varies.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.why.cases import Case, record
from quadvel_policy.policy_file import PolicyFile
from quadvel_why.diagnosis import LIMITS_FILE
from quadvel_why.links import CAUSES
from quadvel_why.reading import read_run
from quadvel_why.signals import Signals
from tests.helpers.robots import ALIENGO

FIRST_SEED = 900
WALK_S = 4.0
HEAD = "# Largest numbers on healthy walks: python -m benchmarks.why.calibrate\nhealthy:\n"


def main(
    walks: Annotated[int, typer.Option(help="Number of healthy walks.")] = 24,
    out: Annotated[Path, typer.Option(help="Folder for the recordings.")] = Path("out/why_limits"),
) -> None:
    """Measure healthy walks."""
    policy = PolicyFile(ALIENGO)
    largest: dict[str, float] = {}
    for seed in range(FIRST_SEED, FIRST_SEED + walks):
        path = record(Case("none", 0, seed), out, WALK_S)
        if not json.loads(path.with_suffix(".json").read_text())["stood"]:
            raise RuntimeError(f"the healthy walk with seed {seed} fell")
        signals = Signals(read_run(path), policy)
        for cause in CAUSES:
            if set(cause.needs) <= signals.parts and (found := cause().measure(signals)) is not None:
                largest[cause.name()] = max(largest.get(cause.name(), 0.0), float(found.value))
    lines = [f"  walks: {walks}", *(f"  {name}: {value:.4g}" for name, value in largest.items())]
    LIMITS_FILE.write_text(HEAD + "\n".join(lines) + "\n")
    print(LIMITS_FILE.read_text())


if __name__ == "__main__":
    typer.run(main)
