"""The dynamic window approach: constant velocities that can be reached soon, of which the one that costs least is commanded.

D. Fox, W. Burgard, S. Thrun, The dynamic window approach to collision avoidance, IEEE Robotics and Automation Magazine 1997.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .rollouts import STEPS

Array = NDArray[np.float64]

COARSE = np.array([1.0, 0.4, 1.2])  # m/s, m/s, rad/s, from the command to the window's edges
FINE = 0.3 * COARSE
COUNTS = (7, 3, 7)


class DynamicWindow:
    """Looks twice: over the window, and round the best in it."""

    def __init__(self, seed: int) -> None:
        axes = [np.linspace(-1.0, 1.0, count) for count in COUNTS]
        self._grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def reset(self) -> None:
        """It keeps nothing."""

    def search(self, cost: Callable[[Array], Array], command: Array, guess: Array, elapsed: float) -> Array:
        """The targets (STEPS, 3) to command; cost: of targets (K, STEPS, 3); guess (3,): commands that may be good."""
        found = np.vstack([command + COARSE * self._grid, guess, np.zeros(3)])
        best = found[cost(_held(found)).argmin()]
        found = np.vstack([best, best + FINE * self._grid])
        best = found[cost(_held(found)).argmin()]
        return np.broadcast_to(best, (STEPS, 3))


def _held(targets: Array) -> Array:
    return np.repeat(targets[:, None], STEPS, axis=1)
