"""Dynamic window approach: search for the velocity targets of the next steps with the lowest cost.

Candidates are constant velocities near the present command, the previous result, and guesses of the
caller. `follow_costs` computes the cost, `rollouts` predicts the motion and has the limits.
Velocities are in the body frame: vx, vy in m/s, wz in rad/s.

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
GRID_COUNTS = (5, 3, 7)  # candidates in vx, vy, wz
SWITCHING_COST = 0.03  # cost by which a candidate must be better than the previous result


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
            cost: Returns the cost (K,) of targets (K, STEPS, 3), lower is better.
            limits: Limits of the commands.
            command: Present command, (3,): vx, vy in m/s, wz in rad/s.
            guesses: Further candidates, (n, STEPS, 3), in the same units.
            elapsed: Time since the previous search, s.

        Returns:
            Targets, (STEPS, 3), one per step of STEP_S: vx, vy in m/s, wz in rad/s.
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
