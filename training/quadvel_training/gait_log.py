"""The kind of gait that the teacher has at some speeds, logged with each numbered checkpoint of stage 1."""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
import torch

from quadvel_eval.gait_kind import GaitKind

from .env import EnvConfig, VelocityEnv
from .privileged import ACTION_BOUND, ACTION_SCALE, Numbered, Past, PrivilegedRun, observe
from .randomisation import Randomisation, actuator
from .walking_rewards import SAMPLE

SPEEDS = (0.5, 1.0, 2.0)  # m/s, straight ahead
WALKED, COUNTED = 6.0, 4.0  # s from standing, of which the last ones count


@attrs.frozen
class StraightAhead:
    """Commands of `SPEEDS`, one robot each, that never change."""

    hold: tuple[float, float] = (1e6, 1e6)  # s

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n, 4): vx (m/s), 0, 0, 0."""
        return np.stack([np.resize(SPEEDS, n), *np.zeros((3, n))], axis=1)

    def contains(self, command: np.ndarray) -> np.ndarray:
        """Whether velocities (n, 3) may be drawn, (n,) bool."""
        return np.isin(command[:, 0], SPEEDS)


def walked(run: PrivilegedRun) -> dict[float, GaitKind | None]:
    """How nominal robots walk at each of `SPEEDS` (m/s) under the run's teacher without exploration; None: it fell."""
    c = run.config
    config = EnvConfig(
        n=len(SPEEDS),
        threads=1,
        period=SAMPLE,
        timestep=c.timestep,
        actuator=actuator(c.actuator),
        randomisation=Randomisation.none(),
        ramped=0.0,
        episode=2 * WALKED,
    )
    env = VelocityEnv(config, StraightAhead())
    past, action = Past(env), np.zeros((env.config.n, 12), np.float32)
    fell = np.zeros(env.config.n, bool)
    contact, sideways = [], []
    for _ in range(round(WALKED / SAMPLE)):
        with torch.no_grad():
            mean = run.actor(torch.from_numpy(observe(env, past, action)))[0].numpy()
        action = mean.clip(-ACTION_BOUND, ACTION_BOUND)
        command = env.command.copy()
        env.tick(env.stand_q + ACTION_SCALE * action)
        past.advance(command)
        fell |= env.fallen
        contact.append(env.contact.copy())
        sideways.append(env.velocity[:, 1].copy())
    last = slice(-round(COUNTED / SAMPLE), None)
    feet, sway = np.array(contact)[last], np.array(sideways)[last]
    return {
        speed: None if fell[i] else GaitKind.of(feet[:, i], sway[:, i], SAMPLE)
        for i, speed in enumerate(SPEEDS)
    }


def row(speed: float, kind: GaitKind | None) -> str:
    """One line of the log."""
    if kind is None:
        return f"gait at {speed:g} m/s: fell"
    return (
        f"gait at {speed:g} m/s: diagonal feet alike {100 * kind.diagonal:.0f} %, "
        f"feet of one side {100 * kind.side:.0f} %, {kind.frequency:.2f} Hz, "
        f"contact ratio {kind.contact_ratio:.2f}, sway {kind.sway:.3f} m/s"
    )


class GaitLog(Numbered):
    """Keeps numbered checkpoints, and prints and plots the kind of gait of each."""

    def __init__(self, run: PrivilegedRun, folder: Path) -> None:
        super().__init__(run, folder)
        self._walker = run

    def keep(self) -> dict[str, float]:
        """Write the checkpoint; print a line for each speed; return the figures, by `gait/SPEED/NAME`."""
        super().keep()
        figures: dict[str, float] = {}
        for speed, kind in walked(self._walker).items():
            print(row(speed, kind), flush=True)
            known = attrs.asdict(kind) if kind else {}
            figures |= {f"gait/{speed:g}/{name}": value for name, value in known.items()}
        return figures
