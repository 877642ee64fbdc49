"""Walks policies of others straight ahead on the simulated Go2: `python -m benchmarks.imported_walk FILE...`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from quadvel_eval.grid import PLANTS
from quadvel_eval.walk import Setup, make_loop, record_until_fall

SPEED, DURATION_S, SETTLING_S, SEEDS = 0.5, 10.0, 2.0, 3  # speed in m/s


def main(paths: Sequence[str]) -> None:
    """Print the mean velocity of each walk, and why it ended if the robot did not walk to the end.

    Args:
        paths: Files of `quadvel policy import`.
    """
    for path in map(Path, paths):
        for plant, fields in PLANTS.items():
            for seed in range(SEEDS):
                loop = make_loop(Setup(robot="go2", policy=path, estimator="kalman", plant=fields), seed, ())
                walk, stood = record_until_fall(loop, [((SPEED, 0.0, 0.0), DURATION_S)])
                if walk is None or not stood:
                    print(path.stem, plant, seed, f"ended: {loop.supervisor.reason}")
                    continue
                mean = walk.velocity[walk.time >= SETTLING_S].mean(axis=0)
                print(path.stem, plant, seed, *mean.round(3))


if __name__ == "__main__":
    main(sys.argv[1:])
