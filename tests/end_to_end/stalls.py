"""Demos on a machine that stalls: how many get through. A program to run by hand; nothing of it is a test.

    python -m tests.end_to_end.stalls --runs 4 --out out/stalls                           # the whole machine, 55 to 60 ms
    python -m tests.end_to_end.stalls --only controller --pause 200 200 --quick

Every second or two all processes of a demo, or one of its nodes, stop for a while, as those of a virtual machine do whose
host is busy. What a run came to goes to DIR/N, its summary as `summary.json`, and one line on the screen.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from random import Random
from typing import Annotated

import typer

DEMO = (sys.executable, "-c", "from quadvel_bringup.__main__ import main; main()", "demo", "--no-video")
START = 4.0  # s, until all nodes run
Range = tuple[float, float]


def family(parent: int) -> list[int]:
    """The process and its children, which has them all: nodes start none of their own."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text()
    return [parent, *map(int, children.split())]


def serves(process: int, node: str) -> bool:
    """Whether a process runs this node."""
    return f"quadvel_bringup.nodes\0{node}\0" in Path(f"/proc/{process}/cmdline").read_text()


def stall(processes: list[int], seconds: float) -> None:
    """Stop the processes, all at once, and let them go on."""
    for number, pause in ((signal.SIGSTOP, seconds), (signal.SIGCONT, 0.0)):
        for process in processes:
            os.kill(process, number)
        time.sleep(pause)


def run(out: Path, options: list[str], only: str, every: Range, pause: Range, rng: Random) -> str:
    """One demo under stalls; what became of it, as one line."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "summary.json").unlink(missing_ok=True)
    stalls = 0
    with (out / "log.txt").open("w") as log:
        demo = subprocess.Popen([*DEMO, *options, "--out", out], stdout=log, stderr=subprocess.STDOUT)
        wait = START
        while demo.poll() is None:
            time.sleep(wait)
            wait = rng.uniform(*every)
            try:
                chosen = [process for process in family(demo.pid) if not only or serves(process, only)]
                stall(chosen, 1e-3 * rng.uniform(*pause))
                stalls += 1
            except (FileNotFoundError, ProcessLookupError):  # it has just ended
                continue
    lines = (out / "log.txt").read_text().splitlines()
    said = [line for line in lines if " | " in line or "ended with" in line or line.startswith("quadvel:")]
    verdict = f"exit {demo.returncode}, {stalls} stalls"
    if (out / "summary.json").exists():
        summary = json.loads((out / "summary.json").read_text())
        loop = summary["loop"]
        verdict += (
            f", falls {summary['falls']}, error_xy {summary['mean_error_xy']:.3f}, {summary['max_error_xy']:.3f} m/s, "
            f"compute p50 {loop['compute_p50_us']:.0f}, p99 {loop['compute_p99_us']:.0f} us, "
            f"overruns {loop['overruns']}, real-time factor {summary['realtime_factor']:.3f}"
        )
    return "; ".join([verdict, *said])


def stalls(
    runs: Annotated[int, typer.Option(help="Demos to run, one after another.")] = 4,
    only: Annotated[str, typer.Option(help="The node to stop; none: all processes.")] = "",
    every: Annotated[Range, typer.Option(help="Time between two stalls, least and most, s.")] = (1.0, 2.0),
    pause: Annotated[Range, typer.Option(help="Length of a stall, least and most, ms.")] = (55.0, 60.0),
    quick: Annotated[bool, typer.Option("--quick", help="The demo's short walk.")] = False,
    seed: Annotated[int, typer.Option(help="Of when they stall, and for how long.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/stalls"),
) -> None:
    """Run demos under stalls."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(60))
    for number in range(runs):
        options, rng = ["--quick"] if quick else [], Random(seed + number)
        print(f"{number}: {run(out / str(number), options, only, every, pause, rng)}", flush=True)


if __name__ == "__main__":
    typer.run(stalls)
