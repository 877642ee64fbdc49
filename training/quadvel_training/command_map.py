"""Which command a walker has to be given to walk at the one wanted: its steady-state error, found and taken out.

Used twice: for the teacher, and for the finished policy, whose file carries its map along.
"""

from __future__ import annotations

from typing import Protocol

import attrs
import numpy as np
import torch

from .env import TICK, EnvConfig, VelocityEnv

EVEN = [
    (0, 0, 0),
    (1, 0, 0),
    (2, 0, 0),
    (0, 2, 0),
    (0, 0, 2),
    (0, 1, 1),
    (3, 0, 0),
    (1, 2, 0),
    (1, 0, 2),
    (1, 1, 1),
]
ODD = [
    (0, 1, 0),
    (0, 0, 1),
    (1, 1, 0),
    (1, 0, 1),
    (0, 3, 0),
    (0, 0, 3),
    (0, 1, 2),
    (0, 2, 1),
    (2, 1, 0),
    (2, 0, 1),
]
EXPONENTS = np.array(EVEN + ODD)
"""Of vx, vy, wz in each term: first those that mirroring leaves as they are, then as many that it turns round."""
TERMS = len(EXPONENTS)
BOUND = 0.6  # m/s, rad/s, of what the map adds
STRIDE = 0.35  # s, time constant of velocities averaged over a stride


class Tracking:
    """Velocities and commands averaged over a stride, and integral action on their difference."""

    def __init__(self, n: int, gain: float) -> None:
        self.gain = gain  # 1/s
        self.velocity = np.zeros((n, 3))  # vx, vy (m/s), wz (rad/s)
        self.command = np.zeros((n, 3))
        self.correction = np.zeros((n, 3))

    @property
    def error(self) -> np.ndarray:
        """Commanded minus measured, (n, 3)."""
        return self.command - self.velocity

    def reset(self, ids: np.ndarray) -> None:
        """Forget the past of `ids`."""
        self.velocity[ids] = self.command[ids] = self.correction[ids] = 0.0

    def advance(self, env: VelocityEnv, wanted: np.ndarray) -> None:
        """One tick further, with the commands (n, 3) that are to be reached."""
        now = np.concatenate([env.velocity[:, :2], env.angular_velocity[:, 2:]], axis=1)
        self.velocity += (now - self.velocity) * TICK / STRIDE
        self.command += (wanted - self.command) * TICK / STRIDE
        self.correction = (self.correction + self.gain * TICK * self.error).clip(-0.5, 0.5)
        self.correction[env.changed] = 0.0

    def corrected(self, command: np.ndarray) -> np.ndarray:
        """(n, 4) with the correction on top, stance as it is."""
        moving = command[:, 3:] < 0.5
        return np.concatenate([command[:, :3] + self.correction * moving, command[:, 3:]], axis=1)


def features(command: np.ndarray) -> np.ndarray:
    """The polynomial's terms (n, TERMS) of vx, vy, wz (n, 3)."""
    return np.prod(command[:, None, :] ** EXPONENTS, axis=-1)


class CommandMap:
    """Which command the teacher needs to walk at the wanted one: wanted + polynomial of it, odd under mirroring where due."""

    def __init__(self, weights: np.ndarray | None = None) -> None:
        self.weights = np.zeros((TERMS, 3)) if weights is None else weights

    def fit(self, wanted: np.ndarray, given: np.ndarray) -> float:
        """Ridge regression of given - wanted, (n, 3) each; returns the residual's RMS."""
        a = features(wanted[:, :3])
        b = given - wanted
        half = a.shape[1] // 2
        self.weights = np.zeros((a.shape[1], 3))
        for axis, columns in ((0, slice(0, half)), (1, slice(half, None)), (2, slice(half, None))):
            part = a[:, columns]
            gram = part.T @ part + 1e-2 * np.eye(part.shape[1])
            self.weights[columns, axis] = np.linalg.solve(gram, part.T @ b[:, axis])
        return float(np.sqrt(np.mean((a @ self.weights - b) ** 2)))

    def __call__(self, command: np.ndarray) -> np.ndarray:
        """(n, 4) wanted -> (n, 4) for the teacher; stance stays as it is."""
        given = command.copy()
        moving = command[:, 3] < 0.5
        added = features(command[:, :3]) @ self.weights
        given[:, :3] += added.clip(-BOUND, BOUND) * moving[:, None]
        return given


class CommandCorrection(torch.nn.Module):
    """What the map adds to the command: observations (n, 48), which start with the command, to (n, 4).

    Few steps, since it runs in every tick: a linear layer picks the factors of each term out of 1, vx, vy, wz; the last
    of the four factors is 0 in stance.
    """

    weights: torch.Tensor

    def __init__(self, command_map: CommandMap, inputs: int) -> None:
        super().__init__()
        self.factors = torch.nn.Linear(inputs, 4 * TERMS).requires_grad_(False)
        pick, one = np.zeros((4, TERMS, inputs)), np.ones((4, TERMS))
        for term, exponents in enumerate(EXPONENTS):
            for place, axis in enumerate(np.repeat([0, 1, 2], exponents)):
                pick[place, term, axis], one[place, term] = 1.0, 0.0
        pick[3, :, 3] = -1.0
        self.factors.weight.copy_(torch.as_tensor(pick.reshape(-1, inputs)))
        self.factors.bias.copy_(torch.as_tensor(one.reshape(-1)))
        weights = np.pad(command_map.weights, ((0, 0), (0, 1)))  # stance stays as it is
        self.register_buffer("weights", torch.as_tensor(weights, dtype=torch.float32))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        terms = self.factors(obs).reshape(-1, 4, TERMS).prod(dim=1)
        return (terms @ self.weights).clamp(-BOUND, BOUND)


class Walker(Protocol):
    """Something that walks on command in a batch of environments, with integral action."""

    env: VelocityEnv
    tracking: Tracking

    def targets(self) -> np.ndarray:
        """Joint targets (n, 12) for the present state."""
        ...

    def advance(self) -> None:
        """After the environment's tick."""
        ...


def held_commands(config: EnvConfig) -> EnvConfig:
    """The same environments with one walking command each, for good."""
    return attrs.evolve(
        config, commands=attrs.evolve(config.commands, hold=(1e3, 1e3), stance=0.0), episode=1e4
    )


def fit_command_map(walker: Walker, seconds: float = 10.0) -> CommandMap:
    """Let integral action settle and fit the map on those that still walk; `walker` stands in `held_commands`."""
    env, n, ticks = walker.env, walker.env.config.n, round(seconds / TICK)
    total, fell = np.zeros((n, 3)), np.zeros(n, bool)
    for tick in range(ticks):
        env.tick(walker.targets())
        walker.advance()
        fell |= env.fallen
        if tick >= ticks // 2:
            total += walker.tracking.correction / (ticks - ticks // 2)
    kept = ~fell & (np.abs(total) < 0.45).all(axis=1)
    command_map = CommandMap()
    left = command_map.fit(env.command[kept, :3], env.command[kept, :3] + total[kept])
    print(
        f"command map of {type(walker).__name__}: {kept.sum()} of {n} walked, residual {left:.3f} (m/s, rad/s)"
    )
    return command_map
