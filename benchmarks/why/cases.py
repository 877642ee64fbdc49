"""The walks of the blind suite: which defect, seed, plant and length each has, and their recordings."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import attrs
import numpy as np

from quadvel_sim.simulator import Simulator

from .defects import DEFECTS, make_defect
from .walks import RecordedWalk, make_script

STRENGTHS = 4
WALK_S = 3.0
SOUND_SHARE = 0.2


@attrs.frozen
class Case:
    """One walk.

    Attributes:
        kind: Kind of the defect, or `none`.
        strength: 0 (weak) to 3.
        seed: Seed of the plant's noise, of the velocities and of the defect.
    """

    kind: str
    strength: int
    seed: int

    @property
    def name(self) -> str:
        """Name of the recording."""
        return f"{self.kind}_{self.strength}_{self.seed}"


def all_cases(suite: int) -> Iterator[Case]:
    """Cases of a suite, the strengths in rounds, so that a part of them is balanced too."""
    sound = round(SOUND_SHARE / (1.0 - SOUND_SHARE) * len(DEFECTS))
    for strength in range(STRENGTHS):
        kinds = [*DEFECTS, *["none"] * sound]
        for k, kind in enumerate(kinds):
            yield Case(kind, strength, 10_000 * suite + 100 * strength + k)


def record(case: Case, folder: Path, seconds: float = WALK_S) -> Path:
    """Record a case unless its recording is there; a JSON file next to it says how the walk ended."""
    path = folder / f"{case.name}.mcap"
    if path.exists():
        return path
    rng = np.random.default_rng([case.seed, 3])
    plant = draw_plant(rng) if case.seed % 2 else {}

    def vary(simulator: Simulator) -> None:
        if case.seed % 2:
            simulator.actuator.sample(rng=rng)
            simulator.actuator.reset()

    walk = RecordedWalk(make_defect(case.kind, case.strength, rng), case.seed, plant, vary)
    stood = walk.run(make_script(case.seed, seconds))
    folder.mkdir(parents=True, exist_ok=True)
    fate = {
        "stood": stood,
        "fault": walk.supervisor.fault,
        "seconds": walk.simulator.time,
        "tracking": walk.tracking_error,
    }
    path.with_suffix(".json").write_text(json.dumps(fate))
    return walk.messages.write(path)


def draw_plant(rng: np.random.Generator) -> dict[str, object]:
    """A plant within the ranges of the training: every second walk has one."""
    return {
        "friction": rng.uniform(0.4, 1.0, 4),
        "payload": rng.uniform(-1.0, 3.0),
    }
