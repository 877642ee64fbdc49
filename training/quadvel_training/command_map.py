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
    (2, 2, 0),
    (2, 0, 2),
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
    (3, 1, 0),
    (3, 0, 1),
]
EXPONENTS = np.array(EVEN + ODD)
"""Of vx, vy, wz in each term: first those that mirroring leaves as they are, then as many that it turns round."""
TERMS = len(EXPONENTS)
FACTORS = EXPONENTS.sum(axis=1).max() + 1  # of a term, with the one of stance
BOUND = 1.0  # m/s, rad/s, of what the map adds
STRIDE = 0.35  # s, time constant of velocities averaged over a stride
SETTLED = 2.0  # s of walking until a robot's velocity counts
RIDGE = 1e-4  # a robot
OUTLIER = 0.3  # m/s, rad/s: a larger error counts as this


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
    powers = command[:, :, None] ** np.arange(EXPONENTS.max() + 1)
    return powers[:, np.arange(3), EXPONENTS].prod(axis=-1)


class CommandMap:
    """Which command a walker needs to walk at the wanted one: wanted + polynomial of it.

    mirrored: the polynomial is odd under mirroring where due, as what a mirrored robot shall learn from has to be. Else it
    takes out, besides, what a robot whose centre of mass is off the middle does to one side only: terms up to second order,
    since robots enough to tell higher ones from chance there are none at the corners of the range.
    """

    def __init__(self, weights: np.ndarray | None = None, mirrored: bool = False) -> None:
        self.weights = np.zeros((TERMS, 3)) if weights is None else weights
        even = np.arange(TERMS) < len(EVEN)
        one_sided = not mirrored and EXPONENTS.sum(axis=1) <= 2
        self._terms = tuple(np.flatnonzero(due | one_sided) for due in (even, ~even, ~even))

    def correct(self, wanted: np.ndarray, missing: np.ndarray) -> None:
        """Add the ridge regression of what is missing of the wanted velocities, (n, 3) each."""
        a = features(wanted)
        for axis, columns in enumerate(self._terms):
            part = a[:, columns]
            gram = part.T @ part + RIDGE * len(a) * np.eye(part.shape[1])
            self.weights[columns, axis] += np.linalg.solve(gram, part.T @ missing[:, axis])

    def __call__(self, command: np.ndarray) -> np.ndarray:
        """(n, 4) wanted -> (n, 4) for the walker; stance stays as it is."""
        given = command.copy()
        moving = command[:, 3] < 0.5
        added = features(command[:, :3]) @ self.weights
        given[:, :3] += added.clip(-BOUND, BOUND) * moving[:, None]
        return given


class CommandCorrection(torch.nn.Module):
    """What the map adds to the command: (..., `inputs`), which start with the command, to (..., `inputs`).

    Few steps, since it runs for every tick: a linear layer picks the factors of each term out of 1, vx, vy, wz; the last
    factor is 0 in stance.
    """

    weights: torch.Tensor

    def __init__(self, command_map: CommandMap, inputs: int) -> None:
        super().__init__()
        self.factors = torch.nn.Linear(inputs, FACTORS * TERMS).requires_grad_(False)
        pick, one = np.zeros((FACTORS, TERMS, inputs)), np.ones((FACTORS, TERMS))
        for term, exponents in enumerate(EXPONENTS):
            for place, axis in enumerate(np.repeat([0, 1, 2], exponents)):
                pick[place, term, axis], one[place, term] = 1.0, 0.0
        pick[-1, :, 3] = -1.0
        self.factors.weight.copy_(torch.as_tensor(pick.reshape(-1, inputs)))
        self.factors.bias.copy_(torch.as_tensor(one.reshape(-1)))
        weights = np.pad(command_map.weights, ((0, 0), (0, inputs - 3)))  # all else stays as it is
        self.register_buffer("weights", torch.as_tensor(weights, dtype=torch.float32))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        terms = self.factors(obs).reshape(*obs.shape[:-1], FACTORS, TERMS).prod(dim=-2)
        return (terms @ self.weights).clamp(-BOUND, BOUND)


class Walker(Protocol):
    """Something that walks on command in a batch of environments, behind a command map of its own."""

    env: VelocityEnv
    own: CommandMap
    tracking: Tracking

    def reset(self, ids: np.ndarray) -> None:
        """Forget the past of `ids`."""
        ...

    def targets(self) -> np.ndarray:
        """Joint targets (n, 12) for the present state."""
        ...

    def advance(self) -> None:
        """After the environment's tick."""
        ...


def held_commands(config: EnvConfig) -> EnvConfig:
    """The same environments with one walking command each, for good."""
    return attrs.evolve(
        config, commands=attrs.evolve(config.commands, hold=(1e6, 1e6), stance=0.0), episode=1e6
    )


@attrs.frozen
class MapFit:
    """How the fit of a command map went: mean error of the robots that walk, m/s, and falls."""

    before: float
    after: float
    falls: int
    robots: int


def fit_command_map(walker: Walker, seconds: float = 16.0, gain: float = 0.8) -> MapFit:
    """Integral action (`gain`, 1/s) on the weights of `walker.own`, from all robots; `walker` stands in `held_commands`.

    So the map makes the walked velocities right and not the given ones, which may be far off where little depends on
    them, as at low speed with dry friction. A robot that falls starts over at another command: where none walks, none counts.
    """
    env, n, every = walker.env, walker.env.config.n, 20
    age, falls, off = np.zeros(n), 0, []
    for tick in range(round(seconds / TICK)):
        env.tick(walker.targets())
        walker.advance()
        age += TICK
        over = np.flatnonzero(env.fallen)
        age[over] = 0.0
        falls += len(over)
        env.reset(over)
        walker.reset(over)
        counts = age > SETTLED
        if tick % every == 0 and counts.any():
            error = walker.tracking.error[counts]
            off.append(float(np.hypot(error[:, 0], error[:, 1]).mean()))
            step = gain * every * TICK * error.clip(-OUTLIER, OUTLIER)
            walker.own.correct(env.command[counts, :3], step)
    if not off:
        raise ValueError(f"command map: no robot of {n} walked for {SETTLED} s at its command")
    fit = MapFit(off[0], off[-1], falls, n)
    print(f"command map: {fit.before:.3f} to {fit.after:.3f} m/s off, {falls} falls of {n} robots")
    return fit
