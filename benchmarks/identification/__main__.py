"""Contest of identifications: publish logs without their truth, enter, and judge.

    python -m benchmarks.identification publish --size tiny --seed 7
    python -m benchmarks.identification enter quadvel ridge network
    python -m benchmarks.identification judge

docs/howto/enter-a-benchmark.md describes it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.progress import track

from benchmarks.identification.contest import SharedLog, publish, read_truth, shared_logs
from benchmarks.identification.entrants import ENTRANTS, Answer
from benchmarks.identification.judge import SCHEMA, judge, judgement_table, read_answers
from benchmarks.provenance import last_commit, library_versions
from quadvel_bringup.error_sentence import exit_with_sentence

ENGINE = ("src/quadvel_actuator", "src/quadvel_sysid", "benchmarks/identification")
NEEDS_TORCH = "network"
LIBRARIES = ("quadvel-core", "numpy", "scipy", "numba", "torch")
app = typer.Typer(add_completion=False)
FolderOption = Annotated[Path, typer.Option("--folder", metavar="<folder>", help="Folder of the contest.")]
FOLDER = Path("out/identification_contest")


@app.command("publish")
def publish_command(
    seed: Annotated[int, typer.Option(help="Seed of the logs.")] = 0,
    size: Annotated[
        Literal["tiny", "small"], typer.Option(help="tiny: 5 logs; small: one of each kind.")
    ] = "small",
    logs: Annotated[int, typer.Option(min=1, help="Logs of each kind.")] = 1,
    folder: FolderOption = FOLDER,
) -> None:
    """Make logs: `logs` is given to the entrants, `truth` is kept."""
    paths = publish(size, seed, folder, logs)
    print(f"written: {len(paths)} logs in {folder / 'logs'}, their truth in {folder / 'truth'}")


@app.command("enter")
def enter_command(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[name]...", help=f"Of {', '.join(ENTRANTS)}.", show_default="all"),
    ] = None,
    folder: FolderOption = FOLDER,
) -> None:
    """Write the answers of our entrants about the logs, one file each."""
    unknown = set(names or ()) - ENTRANTS.keys()
    if unknown:
        raise typer.BadParameter(
            f"found {', '.join(sorted(unknown))}, expected some of {', '.join(ENTRANTS)}"
        )
    chosen = names or list(ENTRANTS)
    if NEEDS_TORCH in chosen and find_spec("torch") is None:
        if names:
            raise typer.BadParameter(f"{NEEDS_TORCH} needs PyTorch, not installed here: make test")
        print(f"left out: {NEEDS_TORCH}, which needs PyTorch (make test installs it)")
        chosen.remove(NEEDS_TORCH)
    logs = list(shared_logs(folder / "logs"))
    (folder / "answers").mkdir(exist_ok=True)
    for name in chosen:
        content = {
            "schema": SCHEMA,
            "entrant": name,
            "commit": last_commit(*ENGINE),
            "versions": library_versions(LIBRARIES),
            "logs": {
                shared.name: _timed(ENTRANTS[name], shared)
                for shared in track(logs, name, console=Console(markup=False, stderr=True))
            },
        }
        (folder / "answers" / f"{name}.json").write_text(json.dumps(content))


def _timed(entrant: Callable[[SharedLog], Answer], shared: SharedLog) -> dict[str, object]:
    """Answer about one log, with the CPU time that it took."""
    start = time.process_time()
    return {**entrant(shared).to_json(), "seconds": round(time.process_time() - start, 2)}


@app.command("judge")
def judge_command(folder: FolderOption = FOLDER) -> None:
    """Compare all files of answers with the truth, and print a table."""
    truths = read_truth(folder / "truth")
    contents = [read_answers(path, truths) for path in sorted((folder / "answers").glob("*.json"))]
    if not contents:
        raise typer.BadParameter(f"{folder / 'answers'}: found no file of answers")
    settings = json.loads((folder / "truth" / "settings.json").read_text())
    print(f"Size {settings['size']}, seed {settings['seed']}, {settings['logs']} logs.\n")
    print(judgement_table([judge(content, truths) for content in contents]))
    print("\n| entrant | commit | made with |\n|---|---|---|")
    for content in contents:
        versions = ", ".join(f"{name} {number}" for name, number in content.get("versions", {}).items())
        print(f"| {content['entrant']} | {content.get('commit', '–')} | {versions or '–'} |")


if __name__ == "__main__":
    with exit_with_sentence("benchmarks.identification"):
        app()
