"""The dynamic window approach: constant velocities that can be reached soon, of which the one that costs least is commanded.

D. Fox, W. Burgard, S. Thrun, The dynamic window approach to collision avoidance, IEEE Robotics and Automation Magazine 1997.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .rollouts import STEP, STEPS, Limits

Array = NDArray[np.float64]

COARSE = np.array([1.0, 0.4, 1.2])  # m/s, m/s, rad/s, from the command to the window's edges
FINE = 0.25 * COARSE
COUNTS = (5, 3, 7)
KEEPS = 0.03  # by which a way has to be better than the last one


class DynamicWindow:
    """Looks twice: over the window, and round the best in it."""

    def __init__(self) -> None:
        axes = [np.linspace(-1.0, 1.0, count) for count in COUNTS]
        self._last = np.zeros((STEPS, 3))
        self._grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def reset(self) -> None:
        """Forget what was chosen last."""
        self._last = np.zeros((STEPS, 3))

    def search(
        self, cost: Callable[[Array], Array], limits: Limits, command: Array, guesses: Array, elapsed: float
    ) -> Array:
        """The targets (STEPS, 3) to command.

        cost: of targets (K, STEPS, 3); command (3,): now; guesses (n, STEPS, 3): targets that may be good; elapsed: s.
        """
        later = elapsed / STEP + np.arange(STEPS)
        last = np.column_stack([np.interp(later, np.arange(STEPS), axis) for axis in self._last.T])
        held = np.vstack([command + COARSE * self._grid, np.zeros(3)])
        targets = limits.held(np.concatenate([last[None], np.repeat(held[:, None], STEPS, axis=1), guesses]))
        costs = cost(targets)
        costs[0] -= KEEPS
        best = targets[costs.argmin()]
        targets = limits.held(np.concatenate([best[None], best + FINE * self._grid[:, None]]))
        costs = cost(targets)
        costs[0] -= KEEPS
        self._last = targets[costs.argmin()]
        return self._last
