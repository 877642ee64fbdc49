"""Scores the identification on logs whose effect nobody declared.

    python -m tests.identification.score --logs 20 --jobs 2 --out out/identification_score [--kinds cogging,none] [--write]

A campaign can be broken off and taken up again: each log's verdict is a file of its own under DIR/cases. Delete DIR after
a change of the tool.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
import time
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import track

from tests.identification import adapter, table
from tests.identification.hidden.cases import GROUP_OF, make_case
from tests.identification.judge import judge

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "results" / "identification_score.md"


def score_case(kind: str, index: int, seed: int) -> dict[str, Any]:
    """One row of the score. An exception of the tool is a verdict as well."""
    case = make_case(kind, index, seed)
    with TemporaryDirectory() as folder:
        paths = case.save(Path(folder) / "truth")
        shown = [path.rename(Path(folder) / path.name) for path in paths]  # without the truth beside it
        start = time.process_time()
        try:
            report = adapter.identify(shown[:1], shown[1:])
        except Exception as error:  # whatever it raises, the campaign goes on
            found: dict[str, Any] = {
                "kind": kind,
                "group": GROUP_OF[kind],
                "error": f"{type(error).__name__}: {error}",
                "trace": traceback.format_exc(),
            }
        else:
            found = judge(report, case.truth) | {
                "report_effects": report["effects"],
                "decision": report["decision"],
            }
        found |= {"seconds": time.process_time() - start}  # of computing: what else runs here does not count
    return {"name": case.name, **found, "truth": case.truth}


def engine() -> str:
    """The last commit that touched the tool, with a + where its files differ from it."""
    tool = ("src/quadvel_actuator", "src/quadvel_sysid")
    said = [
        subprocess.run(
            ["git", *call, "--", *tool], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout
        for call in (("log", "-1", "--format=%h"), ("status", "--porcelain"))
    ]
    return said[0].strip() + ("+" if said[1] else "")


def _work(kind: str, index: int, seed: int, path: Path) -> None:
    """Scores a case into its file."""
    keep(score_case(kind, index, seed) | {"engine": engine()}, path)


def keep(row: dict[str, Any], path: Path) -> None:
    """Write a row of the score into its file, whole or not at all."""
    part = path.with_suffix(f".{os.getpid()}.part")
    part.write_text(json.dumps(row, indent=1, default=float))
    part.replace(path)


def run_campaign(
    kinds: list[str], logs: int, seed: int, jobs: int, out: Path, done: bool = False
) -> list[dict[str, Any]]:
    """Scores what is not scored yet, unless only what is `done` is asked for, and returns all rows of these kinds."""
    folder = out / "cases"
    folder.mkdir(parents=True, exist_ok=True)
    settings = out / "settings.json"
    if settings.exists() and json.loads(settings.read_text())["seed"] != seed:
        raise typer.BadParameter(
            f"{settings}: seed: found {json.loads(settings.read_text())['seed']}, expected {seed}"
        )
    settings.write_text(json.dumps({"seed": seed}))
    cases = [(kind, index, folder / f"{kind}-{index:03d}.json") for index in range(logs) for kind in kinds]
    if done:
        cases = [case for case in cases if case[2].exists()]
    missing = [case for case in cases if not case[2].exists()]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        futures = [pool.submit(_work, kind, index, seed, path) for kind, index, path in missing]
        for future in track(
            as_completed(futures), "Scoring", total=len(futures), console=Console(stderr=True)
        ):
            future.result()
    return [
        json.loads(path.read_text())
        for _, _, path in sorted(cases, key=lambda case: (kinds.index(case[0]), case[1]))
    ]


def main(
    logs: Annotated[
        int, typer.Option(help="Logs a kind; even ones lift feet, odd ones move in mixed ways.")
    ] = 20,
    kinds: Annotated[str, typer.Option(help="Kinds or groups, separated by commas; all without it.")] = "",
    seed: int = 0,
    jobs: int = 2,
    out: Annotated[Path, typer.Option(help="Where verdicts, CSV and page go.")] = Path(
        "out/identification_score"
    ),
    done: Annotated[
        bool, typer.Option("--done", help="Score nothing more: the page of what is there.")
    ] = False,
    write: Annotated[bool, typer.Option("--write", help=f"Write {PAGE.name} in the docs, too.")] = False,
) -> None:
    """Score the identification on logs with undeclared effects."""
    asked = kinds.split(",") if kinds else list(GROUP_OF)
    chosen = [kind for kind in GROUP_OF if kind in asked or GROUP_OF[kind] in asked]
    unknown = set(asked) - set(GROUP_OF) - set(GROUP_OF.values())
    if unknown:
        raise typer.BadParameter(
            f"--kinds: found {', '.join(sorted(unknown))}, expected some of {', '.join(GROUP_OF)}"
        )
    rows = run_campaign(chosen, logs, seed, jobs, out, done)
    page = table.markdown(rows, seed)
    (out / "score.md").write_text(page)
    table.write_csv(rows, out / "score.csv")
    if write:
        PAGE.parent.mkdir(parents=True, exist_ok=True)
        PAGE.write_text(page)
    Console().print(page, markup=False, highlight=False)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    typer.run(main)
