"""Benchmark of the identification on logs with undeclared effects (blind test).

    python -m benchmarks.identification.score --logs 20 --jobs 2 --out out/identification_score [--kinds cogging,none] [--write]
    python -m benchmarks.identification.score --logs 4 --generator other --out out/other_score

The second generator (`benchmarks.identification.other_plant`) shares no code with the first one.
An interrupted run continues where it stopped: the verdict of each log is a file under DIR/cases.
Delete DIR after a change of the identification.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import time
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import track

from benchmarks.identification import adapter, table
from benchmarks.identification.contest import GENERATORS
from benchmarks.identification.verdicts import score_report
from benchmarks.provenance import ROOT, last_commit
from quadvel_sysid.options import DEFAULTS, IdentifyOptions

ENGINE = ("src/quadvel_actuator", "src/quadvel_sysid")
"""Folders of the identification, whose last commit a row names."""
PAGE = ROOT / "docs" / "results" / "identification_score.md"


def score_case(
    kind: str, index: int, seed: int, options: IdentifyOptions = DEFAULTS, generator: str = "first"
) -> dict[str, Any]:
    """Generate one log, identify it and score the report.

    Args:
        kind: Kind of log, a key of the generator's `GROUP_OF`.
        index: Number of the log.
        seed: Seed of the benchmark.
        options: Options of the identification.
        generator: Name of the generator, a key of `GENERATORS`.

    Returns:
        One row of the score. An exception of the identification is a row with `error`.
    """
    cases = GENERATORS[generator]
    case = cases.make_case(kind, index, seed)
    with TemporaryDirectory() as folder:
        paths = case.save(Path(folder) / "truth")
        shown = [path.rename(Path(folder) / path.name) for path in paths]  # the truth stays in another folder
        start = time.process_time()
        try:
            report = adapter.identify(shown[:1], shown[1:], options)
        except Exception as error:  # any exception is a verdict, and the benchmark continues
            found: dict[str, Any] = {
                "kind": kind,
                "group": cases.GROUP_OF[kind],
                "error": f"{type(error).__name__}: {error}",
                "trace": traceback.format_exc(),
            }
        else:
            found = score_report(report, case.truth) | {
                "report_effects": report["effects"],
                "decision": report["decision"],
            }
        found |= {"seconds": time.process_time() - start}  # of CPU time
    return {"name": case.name, **found, "truth": case.truth}


def _work(kind: str, index: int, seed: int, generator: str, path: Path) -> None:
    """Score one log into its file."""
    save_row(score_case(kind, index, seed, generator=generator) | {"engine": last_commit(*ENGINE)}, path)


def save_row(row: dict[str, Any], path: Path) -> None:
    """Write one row of the score to a file, atomically.

    Args:
        row: The row.
        path: File to write.
    """
    part = path.with_suffix(f".{os.getpid()}.part")
    part.write_text(json.dumps(row, indent=1, default=float))
    part.replace(path)


def run_campaign(
    kinds: list[str],
    logs: int,
    seed: int,
    jobs: int,
    out: Path,
    done: bool = False,
    generator: str = "first",
) -> list[dict[str, Any]]:
    """Score all logs that have no file yet.

    Args:
        kinds: Kinds of logs.
        logs: Logs of each kind.
        seed: Seed of the benchmark.
        jobs: Worker processes.
        out: Folder of the verdicts.
        done: Only return existing rows.
        generator: Name of the generator, a key of `GENERATORS`.

    Returns:
        Rows of these kinds, by kind and number.

    Raises:
        BadParameter: If `out` has verdicts of another seed or generator.
    """
    folder = out / "cases"
    folder.mkdir(parents=True, exist_ok=True)
    settings = out / "settings.json"
    expected = {"seed": seed, "generator": generator}
    found = json.loads(settings.read_text()) if settings.exists() else expected
    for name, value in expected.items():
        if found.get(name) != value:
            raise typer.BadParameter(f"{settings}: {name}: found {found.get(name)}, expected {value}")
    settings.write_text(json.dumps(expected))
    cases = [(kind, index, folder / f"{kind}-{index:03d}.json") for index in range(logs) for kind in kinds]
    if done:
        cases = [case for case in cases if case[2].exists()]
    missing = [case for case in cases if not case[2].exists()]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        futures = [pool.submit(_work, kind, index, seed, generator, path) for kind, index, path in missing]
        for future in track(
            as_completed(futures), "Scoring", total=len(futures), console=Console(markup=False, stderr=True)
        ):
            future.result()
    return [
        json.loads(path.read_text())
        for _, _, path in sorted(cases, key=lambda case: (kinds.index(case[0]), case[1]))
    ]


def main(
    logs: Annotated[
        int, typer.Option(help="Logs of each kind; even ones lift feet, odd ones use mixed motions.")
    ] = 20,
    kinds: Annotated[str, typer.Option(help="Kinds or groups, separated by commas (default: all).")] = "",
    seed: int = 0,
    generator: Annotated[str, typer.Option(help="first or other.")] = "first",
    jobs: int = 2,
    out: Annotated[Path, typer.Option(help="Folder of verdicts, CSV and page.")] = Path(
        "out/identification_score"
    ),
    done: Annotated[
        bool, typer.Option("--done", help="Do not score further logs; only build the page.")
    ] = False,
    write: Annotated[bool, typer.Option("--write", help=f"Also write {PAGE.name} in the docs.")] = False,
) -> None:
    """Score the identification on logs with undeclared effects."""
    if generator not in GENERATORS:
        raise typer.BadParameter(f"--generator: found {generator}, expected one of {', '.join(GENERATORS)}")
    groups = GENERATORS[generator].GROUP_OF
    asked = kinds.split(",") if kinds else list(groups)
    chosen = [kind for kind in groups if kind in asked or groups[kind] in asked]
    unknown = set(asked) - set(groups) - set(groups.values())
    if unknown:
        raise typer.BadParameter(
            f"--kinds: found {', '.join(sorted(unknown))}, expected some of {', '.join(groups)}"
        )
    rows = run_campaign(chosen, logs, seed, jobs, out, done, generator)
    page = table.markdown(rows, seed)
    (out / "score.md").write_text(page)
    table.write_csv(rows, out / "score.csv")
    if write:
        PAGE.parent.mkdir(parents=True, exist_ok=True)
        PAGE.write_text(page)
    Console(markup=False).print(page, highlight=False)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    typer.run(main)
