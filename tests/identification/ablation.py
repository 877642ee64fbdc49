"""What each device of the identification's search is worth: the score without it, on the same logs, one after the other.

    python -m tests.identification.ablation --logs 2 --seed 912 --jobs 2 --out out/ablation [--switches nesting,elimination]

Each switch takes one device out. A campaign can be broken off and taken up again, as that of `tests.identification.score`.
Logs that are told otherwise than with everything are what a device changes: the comparison is paired.
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
from tests.identification.score import keep, score_case

WHOLE = "everything"


def _same(found: Any, *_: Any, **__: Any) -> Any:
    return found


def _method_same(_: Any, found: Any, *__: Any, **___: Any) -> Any:
    return found


def _fitted_once(self: Any, one: Any) -> Any:
    evaluator = self._judge
    return evaluator.restrict_joints(evaluator.fit(one.model), len(one.model.effects) - 1).model


SWITCHES: dict[str, dict[str, Any]] = {
    WHOLE: {},
    "second starts": {"candidates.Candidates._fit": _fitted_once},
    "ties at once": {"candidates.SIMPLIFIED": 0},
    "terms at nearby delays": {"candidates.Candidates._deeper": _method_same},
    "finer terms": {"candidates._refined": _same},
    "half as many fits": {"candidates.FITTED": 3, "candidates.FITTED_TERMS": 2},
    "three valleys of delays": {"fit._DELAY_STARTS": 1},
    "far delays": {"fit._FAR_DELAY_CHANGES_S": ()},
    "laws before terms": {"selection._regressor_count": lambda account: account.criterion},
    "nesting": {"selection.Search._replace_by_special_case": _method_same},
    "no repeats": {"selection.duplicates_effect": lambda *_: False},
    "elimination": {"selection.Search.eliminate": _method_same},
    "gains of each joint": {"selection.Search._finer_groups": lambda *_: []},
    "cost of a past": {"library._PAST_COST": 0.0},
    "grid of a screening": {
        "screening._TOTAL_DELAY_CHANGES_S": (0.0,),
        "screening._OUTPUT_DELAYS_S": (0.0025,),
    },
    "kurtosis": {"fitted_model.normality": lambda residual, rows: np.ones(residual.shape[1])},
    "clusters in motion": {"criterion.CLUSTER_MOTION_RAD": 0.0},
    "averaged encoders": {"preparation._steadied": lambda found, _: (found, 0.0)},
    "even clocks": {"preparation.jitters": lambda _: False},
    "sharp accelerations": {
        "log_signals.smooth_part": lambda name, t, dq, slope, come: (slope, np.zeros((dq.shape[1],) * 2))
    },
    "between rows": {"model.BETWEEN": 1, "signals.BETWEEN": 1},
    "losses at random": {"lost_commands._at_random": lambda *_: True},
    "latest delays": {"identify.longest_equivalent_delay": _same, "identify.quantised_delays": _same},
}
"""What is replaced in quadvel_sysid, and by what, to take each device out"""


@contextlib.contextmanager
def without(switches: str) -> Iterator[None]:
    """The identification without some devices, joined by +."""
    with contextlib.ExitStack() as stack:
        for switch in switches.split("+"):
            for name, value in SWITCHES[switch].items():
                stack.enter_context(patch(f"quadvel_sysid.{name}", value))
        yield


def _work(switches: str, kind: str, index: int, seed: int, path: Path) -> None:
    with without(switches):
        keep(score_case(kind, index, seed), path)


def table(rows: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Of each switch: logs told otherwise, those right with everything and without, errors and time as ratios."""
    lines = [
        "| without | logs | told otherwise | right with it | without | error left | computing |",
        "|---|---|---|---|---|---|---|",
    ]
    whole = rows[WHOLE]
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
    logs: Annotated[int, typer.Option(help="Logs a kind.")] = 2,
    switches: Annotated[str, typer.Option(help="Separated by commas; some at once are joined by +.")] = "",
    seed: int = 0,
    jobs: int = 2,
    out: Annotated[Path, typer.Option(help="Where verdicts go.")] = Path("out/ablation"),
) -> None:
    """Score the identification without one of its devices after the other."""
    asked = [WHOLE, *(switches.split(",") if switches else [one for one in SWITCHES if one != WHOLE])]
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
