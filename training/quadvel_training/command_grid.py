"""A grid of commands that grows where they are followed: the curriculum of Margolis et al., "Rapid Locomotion", Section III-C.

Cells over vx, vy and yaw rate. Open are those near rest, those whose commands are followed well enough in xy and in yaw
without a fall, and the neighbours of these; they close again where they are followed no more. Commands are drawn from open
cells alone and held inside `CommandLimits`.
"""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
import torch

from quadvel_policy.observation import CommandLimits

from .loop import CheckpointError

WIDTH = (0.5, 0.4, 0.7)  # of a cell: m/s, m/s, rad/s; about rest lies the middle of one
FIRST = (1.0, 0.4, 1.05)  # m/s, m/s, rad/s: cells whose middle lies so near to rest are open from the start
RECENT = 0.3  # weight of the last command in a cell's success
FOLLOWED = 0.65  # success from which on a cell is followed: three commands in a row, or four of five,
LOST = 0.35  # and below which it is so no more


@attrs.frozen
class GridConfig:
    """Which commands are drawn in the end, and when one counts as followed."""

    vx: tuple[float, float] = (-3.4, 4.5)  # m/s
    vy: float = 2.2  # m/s, either way
    wz: float = 6.3  # rad/s, either way
    curve: float = 4.0  # m/s^2, of `CommandLimits`
    stance: float = 0.3  # share of stance commands: setting off is where robots fall most
    straight: float = 0.25  # share of commands without turning,
    near: float = 0.2  # of commands near rest, with and without turning, which are few among all cells,
    axis: float = 0.15  # of commands along one axis alone, the fastest ones among them; the rest may be any
    hold: tuple[float, float] = (2.0, 6.0)  # s until the next command
    error_xy: float = 0.12  # m/s, mean error up to which a command at rest is followed,
    error_wz: float = 0.12  # rad/s, the same of yaw,
    error_share: float = 0.06  # and so much more with every m/s and rad/s of the command

    answered: CommandLimits = CommandLimits((-2.9, -2.0, -5.0), (2.9, 2.0, 5.0), curve=3.6)
    """The commands that a policy file answers, m/s, rad/s, m/s^2; the grid goes beyond, so that none is at the edge of it.

    Within these the shipped policy's joints stay below 1.1 of their drives' speed on the second plant (`quadvel paper`).
    """

    def limits(self) -> CommandLimits:
        """The commands that belong to the grid."""
        return CommandLimits((self.vx[0], -self.vy, -self.wz), (self.vx[1], self.vy, self.wz), self.curve)


class CommandGrid:
    """Draws commands for `VelocityEnv` and learns from how they were followed.

    What is learned of a command holds for its mirror image, too: the policy is symmetric.
    """

    def __init__(self, config: GridConfig) -> None:
        self.config = config
        self._limits = config.limits()
        back, ahead = (np.abs(end) / WIDTH for end in (self._limits.low, self._limits.high))
        cells = [np.ceil(np.round(end - 0.5, 6)).astype(int) for end in (back, ahead)]
        self._first = -cells[0]  # index of the lowest cell on each axis, 0 about rest
        self.shape = tuple((cells[0] + cells[1] + 1).tolist())
        index = np.stack(np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij"), axis=-1)
        self._middle = (index + self._first) * WIDTH
        nearest = np.sign(self._middle) * np.maximum(np.abs(self._middle) - 0.5 * np.array(WIDTH), 0.0)
        self.allowed = np.array([self._inside(c) for c in nearest.reshape(-1, 3)]).reshape(self.shape)
        self._near = (np.abs(self._middle) <= np.array(FIRST) + 1e-9).all(axis=-1) & self.allowed
        self.success = np.zeros(self.shape)
        self.followed = np.zeros(self.shape, bool)
        self._open_around_followed()

    @property
    def hold(self) -> tuple[float, float]:
        """For how long a command lasts, s."""
        return self.config.hold

    def _inside(self, command: np.ndarray) -> bool:
        return bool(np.allclose(self._limits.clamp(command.tolist()), command))

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n, 4): vx, vy (m/s), wz (rad/s), stance."""
        c = self.config
        kind = rng.random(n)
        straight = kind < c.straight
        near = ~straight & (kind < c.straight + c.near)
        command = np.zeros((n, 4))
        command[:, :3] = self._draw_from(self.open, rng, n)
        command[straight, :3] = self._draw_from(self._plane(2), rng, straight.sum())
        command[near, :3] = self._draw_from(self._near, rng, near.sum())
        command[straight | (near & (rng.random(n) < 0.5)), 2] = 0.0
        along = np.where(kind > 1.0 - c.axis, rng.integers(3, size=n), -1)
        for axis in range(3):
            ids, (one, other) = np.flatnonzero(along == axis), {0, 1, 2} - {axis}
            command[ids, axis] = self._draw_from(self._plane(one) & self._plane(other), rng, len(ids))[
                :, axis
            ]
            command[ids, one] = command[ids, other] = 0.0
        command[:, :3] = [self._limits.clamp(one) for one in command[:, :3].tolist()]
        still = rng.random(n) < c.stance
        command[still] = [0.0, 0.0, 0.0, 1.0]
        return command

    def _plane(self, axis: int) -> np.ndarray:
        """Open cells whose middle is at rest in this axis."""
        return self.open & (self._middle[..., axis] == 0.0)

    def _draw_from(self, cells: np.ndarray, rng: np.random.Generator, n: int) -> np.ndarray:
        middles = self._middle[cells]
        return middles[rng.integers(len(middles), size=n)] + rng.uniform(-0.5, 0.5, (n, 3)) * WIDTH

    def contains(self, command: np.ndarray) -> np.ndarray:
        """Which of the velocities (n, 3) lie in open cells and within the limits, (n,) bool."""
        return np.array([self.open[self.cell_of(one)] and self._inside(one) for one in command], bool)

    def cell_of(self, command: np.ndarray) -> tuple[int, ...]:
        """The index of the cell that a command (3,) lies in."""
        cell = np.floor(command / WIDTH + 0.5).astype(int) - self._first
        return tuple(np.clip(cell, 0, np.array(self.shape) - 1).tolist())

    def note(self, command: np.ndarray, error: np.ndarray, fell: np.ndarray) -> None:
        """What became of walking commands (n, 4): mean errors (n, 2) in xy (m/s) and yaw (rad/s), whether the robot fell (n,)."""
        c = self.config
        speed = np.hypot(command[:, 0], command[:, 1])
        good = error[:, 0] < c.error_xy + c.error_share * speed
        good &= error[:, 1] < c.error_wz + c.error_share * np.abs(command[:, 2])
        good &= ~fell
        for one, followed in zip(command[:, :3], good, strict=True):
            for cell in {self.cell_of(one), self.cell_of(one * [1, -1, -1])}:
                self.success[cell] += RECENT * (followed - self.success[cell])
        self.followed = (self.success > FOLLOWED) | (self.followed & (self.success > LOST))
        self._open_around_followed()

    def _open_around_followed(self) -> None:
        around = np.pad(self.followed, 1)
        grown = self.followed | self._near
        for axis in range(3):
            for step in (-1, 1):
                grown = grown | np.roll(around, step, axis)[1:-1, 1:-1, 1:-1]
        self.open = grown & self.allowed

    def reach(self) -> dict[str, float]:
        """How far commands are followed along each axis (m/s, rad/s), and the share of cells that are open and followed."""
        good = self.followed
        where = np.concatenate([np.zeros((1, 3)), self._middle[good]])
        return {
            "forward": round(float(where[:, 0].max()), 3),
            "back": round(float(where[:, 0].min()), 3),
            "sideways": round(float(where[:, 1].max()), 3),
            "turn": round(float(where[:, 2].max()), 3),
            "open": float(self.open.sum() / self.allowed.sum()),
            "followed": float(good.sum() / self.allowed.sum()),
        }

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        held = {"followed": self.followed, "success": self.success}
        return {name: torch.from_numpy(array.copy()) for name, array in held.items()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint. Raises CheckpointError where the grid was another."""
        if tuple(state["followed"].shape) != self.shape:
            found = tuple(state["followed"].shape)
            raise CheckpointError(f"checkpoint: command grid of {found} cells, expected {self.shape}")
        self.followed, self.success = state["followed"].numpy().copy(), state["success"].numpy().copy()
        self._open_around_followed()
