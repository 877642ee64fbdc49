"""Ablation study of the effect search: its score without each of its options, on the same logs.

    python -m benchmarks.identification.ablation --logs 2 --seed 912 --jobs 2 --out out/ablation [--switches nesting,elimination]

Each switch turns one option off. An interrupted run continues where it stopped, as that of
`benchmarks.identification.score`. The comparison is paired: it counts the logs whose verdict changes.
"""

from __future__ import annotations

import json
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from benchmarks.identification.hidden.cases import GROUP_OF
from benchmarks.identification.score import save_row, score_case
from quadvel_sysid.options import IdentifyOptions, SearchOptions

BASELINE = "everything"


SWITCHES: dict[str, dict[str, Any]] = {
    BASELINE: {},
    "second starts": {"second_starts": False},
    "several finished fits": {"finished_fits": 1},
    "regressors at nearby delays": {"regressors_at_nearby_delays": False},
    "finer regressors": {"finer_regressors": False},
    "half as many fits": {"fitted_effects": 3, "fitted_regressors": 2},
    "three valleys of delays": {"delay_starts": 1},
    "far delays": {"far_delays": False},
    "effects before regressors": {"effects_before_regressors": False},
    "nesting": {"special_cases": False},
    "no repeats": {"no_repeats": False},
    "elimination": {"elimination": False},
    "gains of each joint": {"gains_of_each_joint": False},
    "cost of memory": {"memory_cost": 0.0},
    "grid of a screening": {"screening_grid": False},
    "kurtosis": {"kurtosis_test": False},
    "clusters in motion": {"cluster_motion_rad": 0.0},
    "averaged encoders": {"averaged_encoders": False},
    "even clocks": {"even_clocks": False},
    "sharp accelerations": {"sharp_accelerations": False},
    "between rows": {"instants_per_row": 1},
    "losses at random": {"lost_commands_at_random": False},
    "central delays": {"central_delays": False},
}
"""For each switch the fields of `SearchOptions` that it changes."""


def options_without(switches: str) -> SearchOptions:
    """Turn some options of the search off.

    Args:
        switches: Keys of `SWITCHES`, joined by `+`.

    Returns:
        The options of the search.
    """
    disabled = [SWITCHES[switch] for switch in switches.split("+")]
    return SearchOptions(**{name: value for fields in disabled for name, value in fields.items()})


def _work(switches: str, kind: str, index: int, seed: int, path: Path) -> None:
    """Score one log without some options, into its file."""
    options = IdentifyOptions(search=options_without(switches))
    save_row(score_case(kind, index, seed, options), path)


def table(rows: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Build the table of the study.

    Args:
        rows: Rows of the score by switch and log; `BASELINE` has every option on.

    Returns:
        Markdown: changed verdicts, right verdicts with and without, and ratios of error and time.
    """
    lines = [
        "| without | logs | verdict changes | right with it | right without | error ratio | time ratio |",
        "|---|---|---|---|---|---|---|",
    ]
    whole = rows[BASELINE]
    for switch, found in rows.items():
        both = sorted(found.keys() & whole.keys())
        pairs = [(whole[name], found[name]) for name in both]
        other = sum(
            a.get("named") != b.get("named") or a.get("verdict") != b.get("verdict") for a, b in pairs
        )
        right = [sum(row.get("verdict") == "right" for row in side) for side in zip(*pairs, strict=True)]
        left = [b["after"] / a["after"] for a, b in pairs if "after" in a and "after" in b]
        time = [sum(row["seconds"] for row in side) for side in zip(*pairs, strict=True)]
        lines.append(
            f"| {switch} | {len(both)} | {other} | {right[0]} | {right[1]} | {np.exp(np.mean(np.log(left))):.3f} | "
            f"{time[1] / time[0]:.2f} |"
        )
    return "\n".join(lines)


def main(
    logs: Annotated[int, typer.Option(help="Logs of each kind.")] = 2,
    switches: Annotated[
        str,
        typer.Option(help="Keys of SWITCHES, separated by commas; joined by + to disable several together."),
    ] = "",
    seed: int = 0,
    jobs: int = 2,
    out: Annotated[Path, typer.Option(help="Folder of the verdicts.")] = Path("out/ablation"),
) -> None:
    """Score the identification without each of its options in turn."""
    asked = [BASELINE, *(switches.split(",") if switches else [one for one in SWITCHES if one != BASELINE])]
    unknown = {one for switch in asked for one in switch.split("+")} - SWITCHES.keys()
    if unknown:
        raise typer.BadParameter(
            f"--switches: found {', '.join(sorted(unknown))}, expected some of {', '.join(SWITCHES)}"
        )
    cases = [
        (switch, kind, index, out / switch / f"{kind}-{index:03d}.json")
        for switch in asked
        for kind in GROUP_OF
        for index in range(logs)
    ]
    for switch in asked:
        (out / switch).mkdir(parents=True, exist_ok=True)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        todo = [
            pool.submit(_work, switch, kind, index, seed, path)
            for switch, kind, index, path in cases
            if not path.exists()
        ]
        for one in track(
            as_completed(todo), "Scoring", total=len(todo), console=Console(markup=False, stderr=True)
        ):
            one.result()
    rows = {
        switch: {path.stem: json.loads(path.read_text()) for path in sorted((out / switch).glob("*.json"))}
        for switch in asked
    }
    Console(markup=False).print(table(rows), highlight=False, soft_wrap=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    typer.run(main)
