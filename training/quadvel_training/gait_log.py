"""Kind of gait of the teacher at some speeds, logged with each numbered checkpoint of stage 1.

`quadvel_eval.gait_kind` classifies the gait. The result is only logged: no reward depends on it.
"""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
import torch
from typing_extensions import override

from quadvel_description.robot import load_robot
from quadvel_eval.gait_kind import GaitKind

from .env import EnvConfig, VelocityEnv
from .privileged import ACTION_SCALE, NumberedCheckpoints, Past, PrivilegedRun, observe, total_action
from .randomisation import Randomisation, load_actuator
from .walking_rewards import SAMPLE_S

SPEEDS = (0.5, 1.0, 2.0)  # m/s, straight ahead
WALK_S, MEASURED_S = 6.0, 4.0  # the last MEASURED_S of WALK_S count


@attrs.frozen
class StraightAhead:
    """Constant commands of `SPEEDS`, one robot each.

    Attributes:
        hold: s, time until the next command.
    """

    hold: tuple[float, float] = (1e6, 1e6)

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return the commands.

        Args:
            rng: not used.
            n: number of commands.

        Returns:
            (n, 4): vx (m/s), 0, 0, 0.
        """
        return np.stack([np.resize(SPEEDS, n), *np.zeros((3, n))], axis=1)

    def contains(self, command: np.ndarray) -> np.ndarray:
        """Whether velocities are among the commands.

        Args:
            command: (n, 3), m/s, m/s, rad/s.

        Returns:
            (n,) bool.
        """
        return np.isin(command[:, 0], SPEEDS)


def measure_gaits(run: PrivilegedRun) -> dict[float, GaitKind | None]:
    """Measure the gait of nominal robots under the run's teacher, without exploration.

    Args:
        run: training run.

    Returns:
        Kind of gait by speed, m/s; None if the robot fell.
    """
    c = run.config
    robot = load_robot(c.robot)
    config = EnvConfig(
        robot=robot,
        n=len(SPEEDS),
        threads=1,
        period=SAMPLE_S,
        timestep=c.timestep,
        actuator=load_actuator(robot, c.actuator),
        randomisation=Randomisation.none(),
        ramped=0.0,
        episode=2 * WALK_S,
    )
    env = VelocityEnv(config, StraightAhead())
    past, action = Past(env), np.zeros((env.config.n, 12), np.float32)
    fell = np.zeros(env.config.n, bool)
    contact, sideways = [], []
    for _ in range(round(WALK_S / SAMPLE_S)):
        with torch.no_grad():
            mean = run.actor(torch.from_numpy(observe(env, past, action)))[0].numpy()
        action = total_action(env, past, mean)
        command = env.command.copy()
        env.tick(env.stand_q + ACTION_SCALE * action)
        past.advance(command)
        fell |= env.fallen
        contact.append(env.contact.copy())
        sideways.append(env.velocity[:, 1].copy())
    last = slice(-round(MEASURED_S / SAMPLE_S), None)
    feet, sway = np.array(contact)[last], np.array(sideways)[last]
    return {
        speed: None if fell[i] else GaitKind.of(feet[:, i], sway[:, i], SAMPLE_S)
        for i, speed in enumerate(SPEEDS)
    }


def log_line(speed: float, kind: GaitKind | None) -> str:
    """Format the gait at one speed for the log.

    Args:
        speed: m/s.
        kind: kind of gait; None if the robot fell.

    Returns:
        One line.
    """
    if kind is None:
        return f"gait at {speed:g} m/s: fell"
    return (
        f"gait at {speed:g} m/s: diagonal feet alike {100 * kind.diagonal:.0f} %, "
        f"feet of one side {100 * kind.side:.0f} %, {kind.frequency:.2f} Hz, "
        f"contact ratio {kind.contact_ratio:.2f}, sway {kind.sway:.3f} m/s"
    )


class GaitLog(NumberedCheckpoints):
    """Keeper of numbered checkpoints that also prints and plots the kind of gait."""

    def __init__(self, run: PrivilegedRun, folder: Path) -> None:
        """Keep the checkpoints of a run.

        Args:
            run: training run.
            folder: run directory.
        """
        super().__init__(run, folder)
        self._walker = run

    @override
    def keep(self) -> dict[str, float]:
        """Write the checkpoint, and print a line for each speed.

        Returns:
            Figures by `gait/SPEED/NAME`.
        """
        super().keep()
        figures: dict[str, float] = {}
        for speed, kind in measure_gaits(self._walker).items():
            print(log_line(speed, kind), flush=True)
            known = attrs.asdict(kind) if kind else {}
            figures |= {f"gait/{speed:g}/{name}": value for name, value in known.items()}
        return figures
