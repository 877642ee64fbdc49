"""Dynamic window approach: search over constant velocities that can be reached soon.

D. Fox, W. Burgard, S. Thrun, The dynamic window approach to collision avoidance, IEEE Robotics and
Automation Magazine, 1997.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from quadvel_description.arrays import Array

from .rollouts import STEP_S, STEPS, Limits

COARSE_WINDOW = np.array([1.0, 0.4, 1.2])  # half size: m/s, m/s, rad/s around the command
FINE_WINDOW = 0.25 * COARSE_WINDOW
GRID_COUNTS = (5, 3, 7)
SWITCHING_COST = 0.03  # by which a candidate must be better than the previous result


class DynamicWindow:
    """Two-stage grid search: over the window, then around its best candidate."""

    def __init__(self) -> None:
        """Create the grid."""
        axes = [np.linspace(-1.0, 1.0, count) for count in GRID_COUNTS]
        self._last = np.zeros((STEPS, 3))
        self._grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def reset(self) -> None:
        """Clear the previous result."""
        self._last = np.zeros((STEPS, 3))

    def search(
        self, cost: Callable[[Array], Array], limits: Limits, command: Array, guesses: Array, elapsed: float
    ) -> Array:
        """Find the targets with the lowest cost.

        Args:
            cost: Returns the cost (K,) of targets (K, STEPS, 3).
            limits: Limits of the commands.
            command: Present command, (3,): vx, vy in m/s, wz in rad/s.
            guesses: Further candidates, (n, STEPS, 3).
            elapsed: Time since the previous search, s.

        Returns:
            Targets, (STEPS, 3): vx, vy in m/s, wz in rad/s.
        """
        later = elapsed / STEP_S + np.arange(STEPS)
        last = np.column_stack([np.interp(later, np.arange(STEPS), axis) for axis in self._last.T])
        constant = np.vstack([command + COARSE_WINDOW * self._grid, np.zeros(3)])
        targets = limits.clip(
            np.concatenate([last[None], np.repeat(constant[:, None], STEPS, axis=1), guesses])
        )
        costs = cost(targets)
        costs[0] -= SWITCHING_COST
        best = targets[costs.argmin()]
        targets = limits.clip(np.concatenate([best[None], best + FINE_WINDOW * self._grid[:, None]]))
        costs = cost(targets)
        costs[0] -= SWITCHING_COST
        self._last = targets[costs.argmin()]
        return self._last
