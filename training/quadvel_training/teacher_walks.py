"""Walks of the teacher at constant commands: falls, velocity and kind of gait.

With each numbered checkpoint of stage 1 nominal robots walk, for the log. `python -m quadvel_training
walks` lets robots walk that are drawn and pushed as in training. The teacher does not explore here.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import attrs
import numpy as np
import torch
from typing_extensions import override

from quadvel_description.robot import load_robot
from quadvel_eval.gait_kind import GaitKind

from .env import EnvConfig, NeverReversed, VelocityEnv
from .loop import load
from .networks import Gaussian
from .past import Past
from .privileged import (
    ACTION_SCALE,
    NumberedCheckpoints,
    PrivilegedConfig,
    load_teacher,
    observe,
    total_action,
)
from .randomisation import Randomisation, load_actuator
from .walking_rewards import SAMPLE_S

LOGGED_COMMANDS = ((0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (3.0, 0.0, 0.0))
TABLE_COMMANDS = (
    *((vx, 0.0, 0.0) for vx in (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, -1.0, -2.0, -3.0)),
    *((0.0, vy, 0.0) for vy in (1.0, 1.8)),
    *((0.0, 0.0, wz) for wz in (2.0, 5.0)),
    (1.5, 0.4, 1.0),
    (2.5, 0.0, 1.0),
    (-1.5, -0.4, 1.0),
)  # m/s, m/s, rad/s
WALK_S, MEASURED_S = 8.0, 3.0  # the last MEASURED_S of WALK_S count
RAMPED = 0.7  # share of the robots whose command ramps from rest


@attrs.frozen
class ConstantCommands(NeverReversed):
    """Commands that never change, of the robots in their order.

    Attributes:
        velocities: (n, 3), m/s, m/s, rad/s.
        hold: s, time until the next command.
    """

    velocities: np.ndarray
    hold: tuple[float, float] = (1e6, 1e6)

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return the commands.

        Args:
            rng: not used.
            n: number of commands, all of them.

        Returns:
            (n, 4): vx, vy (m/s), yaw rate (rad/s), 0 as they walk.
        """
        return np.concatenate([self.velocities, np.zeros((n, 1))], axis=1)


@attrs.frozen
class Walk:
    """Walk of some robots at one command.

    Attributes:
        command: (3,), m/s, m/s, rad/s.
        robots: number of robots.
        falls: number of those that fell.
        velocity: (3,), mean of those that did not fall, m/s, m/s, rad/s; NaN if all did.
        error: m/s, distance in xy of the mean velocity of a robot from the command, mean of the robots.
        fastest: largest joint speed as a share of its limit.
        gait: kind of gait of the first robot that did not fall; None if all did.
    """

    command: tuple[float, float, float]
    robots: int
    falls: int
    velocity: np.ndarray
    error: float
    fastest: float
    gait: GaitKind | None

    @property
    def line(self) -> str:
        """One line for the terminal."""
        vx, vy, wz = self.command
        start = f"walk at {vx:g}, {vy:g} m/s, {wz:g} rad/s: {self.falls} of {self.robots} fell"
        if self.gait is None:
            return start
        x, y, turn = self.velocity
        return (
            f"{start}, {x:.3f}, {y:.3f} m/s, {turn:.3f} rad/s, error {self.error:.3f} m/s, "
            f"diagonal feet alike {100 * self.gait.diagonal:.0f} %, feet of one side "
            f"{100 * self.gait.side:.0f} %, {self.gait.frequency:.2f} Hz, contact ratio "
            f"{self.gait.contact_ratio:.2f}, sway {self.gait.sway:.3f} m/s, joints at up to "
            f"{self.fastest:.2f} of their speed limit"
        )


def walk(
    actor: Gaussian,
    config: PrivilegedConfig,
    commands: Sequence[tuple[float, float, float]],
    robots: int,
    randomisation: Randomisation,
) -> list[Walk]:
    """Let robots walk at constant commands from standing.

    Args:
        actor: teacher.
        config: configuration of stage 1: robot, actuators, physics, terrain, threads, seed.
        commands: m/s, m/s, rad/s.
        robots: number of robots for each command.
        randomisation: what varies between robots.

    Returns:
        One walk for each command.
    """
    robot = load_robot(config.robot)
    velocities = np.repeat(np.array(commands), robots, axis=0)
    env_config = EnvConfig(
        robot=robot,
        n=len(velocities),
        threads=config.threads,
        seed=config.seed,
        period=SAMPLE_S,
        timestep=config.timestep,
        actuator=load_actuator(robot, config.actuator),
        randomisation=randomisation,
        terrain=config.terrain,
        ramped=RAMPED,
        episode=10 * WALK_S,
    )
    env = VelocityEnv(env_config, ConstantCommands(velocities))
    past, action = Past(env), np.zeros((env.config.n, 12), np.float32)
    fell = np.zeros(env.config.n, bool)
    velocity, contact, fastest = [], [], []
    for _ in range(round(WALK_S / SAMPLE_S)):
        with torch.no_grad():
            mean = actor(torch.from_numpy(observe(env, past, action)))[0].numpy()
        action = total_action(env, past, mean)
        command = env.command.copy()
        env.tick(env.stand_q + ACTION_SCALE * action)
        past.advance(command)
        fell |= env.fallen
        velocity.append(env.planar_velocity)
        contact.append(env.contact.copy())
        fastest.append((env.fastest / robot.velocity_limit).max(axis=1))
    last = slice(-round(MEASURED_S / SAMPLE_S), None)
    seen = np.array(velocity)[last], np.array(contact)[last], np.array(fastest)[last]
    return [
        _walk_of(command, fell[i : i + robots], *(rows[:, i : i + robots] for rows in seen))
        for i, command in zip(range(0, len(fell), robots), commands, strict=True)
    ]


def _walk_of(
    command: tuple[float, float, float],
    fell: np.ndarray,
    velocity: np.ndarray,
    contact: np.ndarray,
    fastest: np.ndarray,
) -> Walk:
    """Walk of the robots at one command, from their last rows (T, robots, ...)."""
    up = np.flatnonzero(~fell)
    if not len(up):
        return Walk(command, len(fell), len(fell), np.full(3, np.nan), np.nan, np.nan, None)
    means = velocity[:, up].mean(axis=0)
    error = np.hypot(*(means[:, :2] - command[:2]).T).mean()
    gait = GaitKind.of(contact[:, up[0]], velocity[:, up[0], 1], SAMPLE_S)
    falls, most = int(fell.sum()), float(fastest[:, up].max())
    return Walk(command, len(fell), falls, means.mean(axis=0), float(error), most, gait)


def walk_drawn_robots(checkpoint: Path, config: PrivilegedConfig, robots: int) -> list[Walk]:
    """Let robots of a recipe walk at `TABLE_COMMANDS`, with pushes as in training.

    Args:
        checkpoint: checkpoint of stage 1.
        config: configuration of the recipe.
        robots: number of robots for each command.

    Returns:
        One walk for each command.

    Raises:
        FileNotFoundError: there is no such file.
    """
    return walk(load_teacher(load(checkpoint)), config, TABLE_COMMANDS, robots, config.randomisation)


class WalkLog(NumberedCheckpoints):
    """Keeper of numbered checkpoints that also prints and plots walks of nominal robots."""

    @override
    def keep(self) -> dict[str, float]:
        """Write the checkpoint, and print a line for each command of `LOGGED_COMMANDS`.

        Returns:
            Figures by `walk/VX/NAME`.
        """
        super().keep()
        figures: dict[str, float] = {}
        for one in walk(self._run.actor, self._run.config, LOGGED_COMMANDS, 1, Randomisation.none()):
            print(one.line, flush=True)
            if one.gait:
                known = {"velocity": float(one.velocity[0])} | attrs.asdict(one.gait)
                figures |= {f"walk/{one.command[0]:g}/{name}": value for name, value in known.items()}
        return figures
