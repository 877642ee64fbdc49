"""Command curriculum: a grid of commands that grows where they are followed.

Source: Margolis et al., Rapid Locomotion via Reinforcement Learning, Section III-C.

Cells span vx, vy and yaw rate. Open cells are those near rest, those whose commands are followed
well in xy and yaw without a fall, and their neighbours. They close again if commands are followed
no longer. Commands are drawn from open cells and limited by `VelocityCommandLimits`.
"""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
import torch

from quadvel_policy.observation import VelocityCommandLimits

from .loop import CheckpointError

CELL_WIDTH = (0.5, 0.4, 0.7)  # m/s, m/s, rad/s; one cell is centred at rest
INITIAL_REACH = (1.0, 0.4, 1.05)  # m/s, m/s, rad/s: cells centred within it are open from the start
SUCCESS_WEIGHT = 0.3  # of the last command in a cell's success
FOLLOWED_SUCCESS = 0.65  # a cell above it is followed: three commands in a row, or four of five
LOST_SUCCESS = 0.35  # a followed cell below it is followed no longer


@attrs.frozen
class GridConfig:
    """Range of the commands, how they are drawn, and when one counts as followed.

    Attributes:
        vx: m/s, from and to.
        vy: m/s, either way.
        wz: rad/s, either way.
        curve: m/s^2, limit in curves of `VelocityCommandLimits`.
        stance: share of commands to stand; setting off is where robots fall most.
        straight: share of commands without yaw.
        near: share of commands near rest, which are few among all cells.
        axis: share of commands along one axis only, where limits allow the highest speeds. What the
            shares leave is drawn from all open cells.
        frontier: share of the commands along one axis that is drawn from open cells which are not
            followed yet; among all open cells, those at the highest speeds are rare.
        hold: s, from and to, until the next command.
        error_xy: m/s, mean error up to which a command at rest counts as followed.
        error_wz: rad/s, the same for yaw.
        error_share: increase of both per m/s and rad/s of the command.
        taught: limits within those of the grid that commands are drawn from, m/s, rad/s, m/s^2; None
            for those of the grid. The cells, which a checkpoint keeps, do not depend on them.
        answered: commands that a policy file accepts, m/s, rad/s, m/s^2. The grid is larger, so
            that none is at its edge. Within these, joints of the shipped policy stay below 1.1 of
            their drives' speed on the second plant (`quadvel paper`).
    """

    vx: tuple[float, float] = (-3.4, 4.5)
    vy: float = 2.2
    wz: float = 6.3
    curve: float = 4.0
    stance: float = 0.3
    straight: float = 0.25
    near: float = 0.2
    axis: float = 0.15
    frontier: float = 0.5
    hold: tuple[float, float] = (2.0, 6.0)
    error_xy: float = 0.12
    error_wz: float = 0.12
    error_share: float = 0.06
    taught: VelocityCommandLimits | None = None
    answered: VelocityCommandLimits = VelocityCommandLimits((-2.2, -1.5, -5.0), (2.6, 1.5, 5.0), curve=2.05)

    def limits(self) -> VelocityCommandLimits:
        """Return the limits of the grid.

        Returns:
            Limits of the commands that may be drawn.
        """
        return VelocityCommandLimits(
            (self.vx[0], -self.vy, -self.wz), (self.vx[1], self.vy, self.wz), self.curve
        )


class CommandGrid:
    """Curriculum of commands for `VelocityEnv`.

    What is learned about a command also holds for its mirror image, as the policy is symmetric.

    Attributes:
        config: configuration.
        shape: number of cells along each axis.
        allowed: cells that reach into the limits, bool.
        success: low-passed success of each cell, 0 to 1.
        followed: cells whose commands are followed, bool.
        open: cells that commands are drawn from, bool.
    """

    def __init__(self, config: GridConfig) -> None:
        """Create a grid with the cells near rest open.

        Args:
            config: configuration.
        """
        self.config = config
        reach, self._limits = config.limits(), config.taught or config.limits()
        back, ahead = (np.abs(end) / CELL_WIDTH for end in (reach.low, reach.high))
        cells = [np.ceil(np.round(end - 0.5, 6)).astype(int) for end in (back, ahead)]
        self._first = -cells[0]  # index of the lowest cell on each axis; 0 at rest
        self.shape = tuple((cells[0] + cells[1] + 1).tolist())
        index = np.stack(np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij"), axis=-1)
        self._middle = (index + self._first) * CELL_WIDTH
        self.allowed = self._cells_within_limits()
        self._near = (np.abs(self._middle) <= np.array(INITIAL_REACH) + 1e-9).all(axis=-1) & self.allowed
        self.success = np.zeros(self.shape)
        self.followed = np.zeros(self.shape, bool)
        self._open_around_followed()

    @property
    def hold(self) -> tuple[float, float]:
        """Time until the next command, from and to, s."""
        return self.config.hold

    def _cells_within_limits(self) -> np.ndarray:
        """Cells that reach into the limits, bool, of the grid's shape."""
        nearest = np.sign(self._middle) * np.maximum(np.abs(self._middle) - 0.5 * np.array(CELL_WIDTH), 0.0)
        return np.array([self._inside(c) for c in nearest.reshape(-1, 3)]).reshape(self.shape)

    def _inside(self, command: np.ndarray) -> bool:
        """Whether a command (3,) lies within the limits."""
        return bool(np.allclose(self._limits.clamp(command.tolist()), command))

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Draw commands from open cells.

        Args:
            rng: source of randomness.
            n: number of commands.

        Returns:
            (n, 4): vx, vy (m/s), wz (rad/s), 1 for stance.
        """
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
            command[ids] = 0.0
            command[ids, axis] = self._draw_along(self._plane(one) & self._plane(other), rng, len(ids))[
                :, axis
            ]
        command[:, :3] = [self._limits.clamp(one) for one in command[:, :3].tolist()]
        still = rng.random(n) < c.stance
        command[still] = [0.0, 0.0, 0.0, 1.0]
        return command

    def _draw_along(self, cells: np.ndarray, rng: np.random.Generator, n: int) -> np.ndarray:
        """Draw commands (n, 3) from open cells of an axis, more often from those not yet followed."""
        drawn, new = self._draw_from(cells, rng, n), cells & ~self.followed
        if new.any():
            ids = np.flatnonzero(rng.random(n) < self.config.frontier)
            drawn[ids] = self._draw_from(new, rng, len(ids))
        return drawn

    def _plane(self, axis: int) -> np.ndarray:
        """Open cells whose middle is 0 on an axis."""
        return self.open & (self._middle[..., axis] == 0.0)

    def _draw_from(self, cells: np.ndarray, rng: np.random.Generator, n: int) -> np.ndarray:
        """Draw commands uniformly from cells."""
        middles = self._middle[cells]
        return middles[rng.integers(len(middles), size=n)] + rng.uniform(-0.5, 0.5, (n, 3)) * CELL_WIDTH

    def contains(self, command: np.ndarray) -> np.ndarray:
        """Whether velocities lie in open cells and within the limits.

        Args:
            command: (n, 3), m/s, m/s, rad/s.

        Returns:
            (n,) bool.
        """
        return np.array([self.open[self.cell_of(one)] and self._inside(one) for one in command], bool)

    def cell_of(self, command: np.ndarray) -> tuple[int, ...]:
        """Find the cell of a command.

        Args:
            command: (3,), m/s, m/s, rad/s.

        Returns:
            Index along each axis.
        """
        cell = np.floor(command / CELL_WIDTH + 0.5).astype(int) - self._first
        return tuple(np.clip(cell, 0, np.array(self.shape) - 1).tolist())

    def record(self, command: np.ndarray, error: np.ndarray, fell: np.ndarray) -> None:
        """Record how walking commands were followed, and update the open cells.

        Args:
            command: (n, 4).
            error: (n, 2), mean errors in xy (m/s) and yaw (rad/s).
            fell: (n,) bool.
        """
        c = self.config
        speed = np.hypot(command[:, 0], command[:, 1])
        # followed: no fall, e_xy < error_xy + error_share |c_xy|, e_wz < error_wz + error_share
        # |c_wz|
        # success <- success + SUCCESS_WEIGHT (followed - success)
        good = error[:, 0] < c.error_xy + c.error_share * speed
        good &= error[:, 1] < c.error_wz + c.error_share * np.abs(command[:, 2])
        good &= ~fell
        for one, followed in zip(command[:, :3], good, strict=True):
            for cell in {self.cell_of(one), self.cell_of(one * [1, -1, -1])}:
                self.success[cell] += SUCCESS_WEIGHT * (followed - self.success[cell])
        self.followed = (self.success > FOLLOWED_SUCCESS) | (self.followed & (self.success > LOST_SUCCESS))
        self._open_around_followed()

    def _open_around_followed(self) -> None:
        """Open the cells that are followed or near rest, and the neighbours of the followed ones."""
        around = np.pad(self.followed, 1)
        grown = self.followed | self._near
        for axis in range(3):
            for step in (-1, 1):
                grown = grown | np.roll(around, step, axis)[1:-1, 1:-1, 1:-1]
        self.open = grown & self.allowed

    def summary(self) -> dict[str, float]:
        """Return how far commands are followed.

        Returns:
            Reach along each axis (m/s, rad/s), and the shares of cells that are open and followed.
        """
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
        """Return what a checkpoint keeps.

        Returns:
            Tensors, for `restore`.
        """
        arrays = {"followed": self.followed, "success": self.success}
        return {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from a checkpoint.

        Args:
            state: what `state` returned.

        Raises:
            CheckpointError: the checkpoint has a grid of another shape.
        """
        if tuple(state["followed"].shape) != self.shape:
            found = tuple(state["followed"].shape)
            raise CheckpointError(f"checkpoint: command grid of {found} cells, expected {self.shape}")
        self.followed, self.success = state["followed"].numpy().copy(), state["success"].numpy().copy()
        self._open_around_followed()
