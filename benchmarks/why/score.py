"""Blind suite of `quadvel why`: walks with hidden defects, and the share that the diagnosis names rightly.

    python -m benchmarks.why.score --suite 2 --out out/why_score [--kinds slipping,none] [--rounds 4]

Each round holds every kind at one strength and a fifth of sound walks. Recordings and answers lie in the folder, so
an interrupted run continues. Delete the answers (*.answer.json) after a change of the diagnosis.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.why.cases import STRENGTHS, Case, all_cases, record
from benchmarks.why.defects import ALSO_RIGHT
from quadvel_policy.policy_file import PolicyFile
from quadvel_why.diagnosis import diagnose
from quadvel_why.reading import read_run
from quadvel_why.signals import Signals
from tests.helpers.robots import ALIENGO

EQUAL_TRACKING = 1.1
"""A walk whose tracking error is within this factor of the sound walk's shows no effect of its defect."""
SOUND = "none"


def answer(case: Case, folder: Path, policy: PolicyFile) -> dict[str, Any]:
    """Record and diagnose a case, unless its answer is there."""
    path = folder / f"{case.name}.answer.json"
    if path.exists():
        return dict(json.loads(path.read_text()))
    recording = record(case, folder)
    begin, used = time.perf_counter(), time.process_time()
    run = read_run(recording)
    found = diagnose(Signals(run, policy)).finding
    result = {
        "kind": case.kind,
        "strength": case.strength,
        "found": SOUND if found is None else found.cause.name(),
        "alternatives": [] if found is None else [name for name, _ in found.measurement.alternatives],
        "sentence": "" if found is None else found.measurement.sentence,
        "seconds": time.perf_counter() - begin,
        "cpu_seconds": time.process_time() - used,
        "recorded_s": run.duration,
    }
    if not is_right(result):
        result["has_effect"] = has_effect(case, folder)
    path.write_text(json.dumps(result, indent=1))
    return result


def is_right(result: dict[str, Any]) -> bool:
    """Whether the answer is the injected defect, or names it as what looks the same."""
    names = {result["found"], *result["alternatives"]}
    return result["kind"] in names or result["found"] in ALSO_RIGHT.get(result["kind"], ())


def has_effect(case: Case, folder: Path) -> bool:
    """Whether the robot fell or tracks worse than the same robot without the defect."""
    if case.kind == SOUND:
        return False
    twin = Case(SOUND, case.strength, case.seed)
    record(twin, folder / "twins")
    with_defect, without = (
        json.loads((place / f"{one.name}.json").read_text())
        for place, one in ((folder, case), (folder / "twins", twin))
    )
    return not with_defect["stood"] or with_defect["tracking"] > EQUAL_TRACKING * without["tracking"]


def report(results: Sequence[dict[str, Any]]) -> str:
    """The table of results: a line for each kind with a miss, and the sums."""
    defects, sound = ([r for r in results if (r["kind"] == SOUND) is wanted] for wanted in (False, True))
    right = [r for r in defects if is_right(r)]
    weak = [r for r in defects if not is_right(r) and not r["has_effect"]]
    alarms = [r for r in sound if r["found"] != SOUND]
    lines = []
    for kind in dict.fromkeys(r["kind"] for r in results):
        missed = [f"{r['strength']}: {r['found']}" for r in results if r["kind"] == kind and not is_right(r)]
        count = sum(r["kind"] == kind for r in results)
        lines.append(f"| `{kind}` | {count - len(missed)} of {count} | {', '.join(missed)} |")
    wrong = Counter(r["found"] for r in defects if not is_right(r) and r["found"] != SOUND)
    seconds = np.array([r["cpu_seconds"] for r in results])
    head = ["| kind | named rightly | instead (strength: name) |", "|---|---|---|"]
    sums = [
        "",
        f"- defects named rightly: {len(right)} of {len(defects)} ({100 * len(right) / max(len(defects), 1):.1f} %)",
        f"- of the others, without any effect on the walk: {len(weak)}",
        f"- defects with another name: {sum(wrong.values())} {dict(wrong) or ''}",
        f"- sound walks with 'and nothing else': {len(sound) - len(alarms)} of {len(sound)}; false alarms: {len(alarms)}",
        f"- processor time of a diagnosis: {np.median(seconds):.1f} s on the median, at most {seconds.max():.1f} s",
    ]
    return "\n".join([*head, *lines, *sums])


def main(
    suite: Annotated[int, typer.Option(help="Number of the suite: its seeds.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for recordings and answers.")] = Path("out/why_score"),
    kinds: Annotated[str, typer.Option(help="Kinds, separated by commas; empty: all.")] = "",
    rounds: Annotated[int, typer.Option(help="Strengths, from weak to strong.")] = STRENGTHS,
) -> None:
    """Measure the diagnosis."""
    policy, wanted = PolicyFile(ALIENGO), set(filter(None, kinds.split(",")))
    folder = out / f"suite_{suite}"
    folder.mkdir(parents=True, exist_ok=True)
    results = []
    for case in all_cases(suite):
        if case.strength < rounds and (not wanted or case.kind in wanted):
            results.append(result := answer(case, folder, policy))
            if not is_right(result):
                print(f"{case.name}: {result['found']}: {result['sentence']}", flush=True)
    print(report(results))


if __name__ == "__main__":
    typer.run(main)
