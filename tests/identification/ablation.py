"""Ablation study of the effect search: its score without each device, on the same logs.

    python -m tests.identification.ablation --logs 2 --seed 912 --jobs 2 --out out/ablation [--switches nesting,elimination]

Each switch disables one device. An interrupted run continues where it stopped, as that of
`tests.identification.score`. The comparison is paired: it counts the logs whose verdict changes.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from tests.identification.hidden.cases import GROUP_OF
from tests.identification.score import save_row, score_case

BASELINE = "everything"


def _identity(found: Any, *_: Any, **__: Any) -> Any:
    """Replacement for a function: returns its first argument."""
    return found


def _identity_method(_: Any, found: Any, *__: Any, **___: Any) -> Any:
    """Replacement for a method: returns its first argument after self."""
    return found


def _fitted_once(self: Any, one: Any) -> Any:
    """Replacement for the fit of a candidate: one start instead of several."""
    evaluator = self._evaluator
    return evaluator.restrict_joints(evaluator.fit(one.model), len(one.model.effects) - 1).model


SWITCHES: dict[str, dict[str, Any]] = {
    BASELINE: {},
    "second starts": {"candidates.Candidates._fit_candidate": _fitted_once},
    "sharing per candidate": {"candidates.MAX_SHARED_TRIALS": 0},
    "terms at nearby delays": {"candidates.Candidates._refit_near_delays": _identity_method},
    "finer terms": {"candidates._refine_term": _identity},
    "half as many fits": {"candidates.MAX_FITTED_LAWS": 3, "candidates.MAX_FITTED_TERMS": 2},
    "three valleys of delays": {"fit._DELAY_STARTS": 1},
    "far delays": {"fit._FAR_DELAY_CHANGES_S": ()},
    "laws before terms": {"selection._term_count": lambda fitted: fitted.criterion},
    "nesting": {"selection.Search._replace_by_special_case": _identity_method},
    "no repeats": {"selection.duplicates_effect": lambda *_: False},
    "elimination": {"selection.Search.eliminate": _identity_method},
    "gains of each joint": {"selection.Search._finer_groupings": lambda *_: []},
    "cost of memory": {"library._MEMORY_COST": 0.0},
    "grid of a screening": {
        "screening._TOTAL_DELAY_CHANGES_S": (0.0,),
        "screening._OUTPUT_DELAYS_S": (0.0025,),
    },
    "kurtosis": {"fitted_model.normality_p_values": lambda residual, rows: np.ones(residual.shape[1])},
    "clusters in motion": {"criterion.CLUSTER_MOTION_RAD": 0.0},
    "averaged encoders": {"preparation._choose_averaging": lambda found, _: (found, 0.0)},
    "even clocks": {"preparation.has_jitter": lambda _: False},
    "sharp accelerations": {
        "log_signals.split_acceleration": lambda name, t, dq, slope, come: (
            slope,
            np.zeros((dq.shape[1],) * 2),
        )
    },
    "between rows": {"model.INSTANTS_PER_ROW": 1, "signals.INSTANTS_PER_ROW": 1},
    "losses at random": {"lost_commands._at_random": lambda *_: True},
    "longest delays": {
        "identify.longest_equivalent_delay": _identity,
        "identify.quantised_delays": _identity,
    },
}
"""For each device the names in quadvel_sysid to replace, and the replacements that disable it."""


@contextlib.contextmanager
def without(switches: str) -> Iterator[None]:
    """Disable some devices of the identification.

    Args:
        switches: Keys of `SWITCHES`, joined by `+`.

    Yields:
        Nothing; the devices are restored on exit.
    """
    with contextlib.ExitStack() as stack:
        for switch in switches.split("+"):
            for name, value in SWITCHES[switch].items():
                stack.enter_context(patch(f"quadvel_sysid.{name}", value))
        yield


def _work(switches: str, kind: str, index: int, seed: int, path: Path) -> None:
    """Score one log without some devices, into its file."""
    with without(switches):
        save_row(score_case(kind, index, seed), path)


def table(rows: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Build the table of the study.

    Args:
        rows: Rows of the score by switch and log; `BASELINE` has every device.

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
    """Score the identification without each of its devices in turn."""
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
        for one in track(as_completed(todo), "Scoring", total=len(todo), console=Console(stderr=True)):
            one.result()
    rows = {
        switch: {path.stem: json.loads(path.read_text()) for path in sorted((out / switch).glob("*.json"))}
        for switch in asked
    }
    Console().print(table(rows), markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    typer.run(main)
